#!/usr/bin/python3
"""The job scripts without a Slurm: syntax, options that sbatch knows, and what they do with every exit code when `srun`
and `scontrol` are stand-ins. On a real Slurm: tools/slurm_test.py."""
import os
import re
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import SOURCE, fail, require, say, scratch

SCRIPTS = sorted((SOURCE / "jobscripts").glob("*.sbatch"))
# Of the manual page of sbatch (22.05), with a value or without
WITH_VALUE = {"account", "array", "begin", "chdir", "clusters", "comment", "constraint", "core-spec",
              "cores-per-socket", "cpus-per-task", "deadline", "dependency", "distribution", "error", "exclude", "export",
              "gpus", "gpus-per-node", "gres", "hint", "job-name", "licenses", "mail-type", "mail-user", "mem",
              "mem-per-cpu", "nice", "nodelist", "nodes", "ntasks", "ntasks-per-core", "ntasks-per-node",
              "ntasks-per-socket", "open-mode", "output", "partition", "priority", "qos", "reservation", "signal",
              "sockets-per-node", "switches", "threads-per-core", "time", "time-min", "tmp"}
WITHOUT = {"contiguous", "exclusive", "requeue", "no-requeue", "overcommit", "oversubscribe", "spread-job"}
VALUES = {"signal": r"USR1@\d+", "time": r"\d\d:\d\d:\d\d", "open-mode": "append", "array": r"[\d,-]+(%\d+)?",
          "nodes": r"\d+", "ntasks-per-node": r"\d+", "cpus-per-task": r"\d+", "job-name": r"\w+",
          "mail-type": r"(FAIL|END|TIME_LIMIT|REQUEUE|BEGIN)(,(FAIL|END|TIME_LIMIT|REQUEUE|BEGIN))*"}


def check_text(path):
    text = path.read_text()
    done = subprocess.run(["bash", "-n", path], capture_output=True, text=True)
    require(done.returncode == 0 and not done.stderr, f"bash -n {path.name}: {done.stderr}")
    options, lines = {}, text.split("\n")
    require(lines[0] == "#!/usr/bin/env bash", f"{path.name}: first line {lines[0]}")
    for number, line in enumerate(lines, 1):
        require(len(line) <= 120, f"{path.name}:{number}: {len(line)} columns")
        if not line.startswith("#SBATCH"):
            continue
        require(all(not other or other.startswith("#") for other in lines[:number]),
                f"{path.name}:{number}: sbatch reads no options after the first command")
        found = re.match(r"#SBATCH --([\w-]+)(?:=(\S+))?(?:\s+# .*)?$", line)
        require(found, f"{path.name}:{number}: '{line}' is not an option")
        name, value = found.groups()
        require(name in (WITH_VALUE if value else WITHOUT), f"{path.name}:{number}: unknown option --{name}={value}")
        require(name not in VALUES or re.fullmatch(VALUES[name], value), f"{path.name}:{number}: --{name}={value}")
        require(name not in options, f"{path.name}:{number}: --{name} twice")
        options[name] = value
    require({"job-name", "nodes", "ntasks-per-node", "cpus-per-task", "time"} <= set(options), f"{path.name}: {options}")
    if "scontrol requeue" in text:
        require({"signal", "requeue", "open-mode"} <= set(options) and "max_tries=" in text,
                f"{path.name} requeues itself without a signal, --requeue, --open-mode or a bound")
    require(text.count("\n# Nothing to edit below.") == 1, f"{path.name}: where does editing end?")
    head = text.partition("\n# Nothing to edit below.")[0]
    for name in ("program", "input", "output", "mpi"):
        require(len(re.findall(rf"^{name}=", head, re.M)) == 1, f"{path.name}: no line {name}=")
    require(text.count("--cpus-per-task=\"$SLURM_CPUS_PER_TASK\"") >= 1, f"{path.name}: srun without --cpus-per-task")
    named = re.search(r'^input="\$HOME/dendrift/(.*)"', head, re.M)[1]
    require((SOURCE / named).is_file(), f"{path.name}: no {named}")
    return options


STAND_INS = {
    "srun": """#!/usr/bin/env bash
echo "$@" >>"$WORK/srun.txt"
n=$(wc -l <"$WORK/srun.txt")
for word in "$@"; do [[ "$word" != output.dir=* ]] || out="${word#output.dir=}"; done
mkdir -p "$out"
read -r code step manifest <<<"$(sed -n "${n}p" "$WORK/plan.txt")"
[ "$step" = - ] || touch "$out/chk_$(printf %07d "$step").h5"
echo "{\\"status\\": \\"$manifest\\"}" >"$out/manifest.json"
exit "$code"
""",
    "scontrol": '#!/usr/bin/env bash\n[ ! -e "$WORK/forbidden" ] || exit 1\necho "$@" >>"$WORK/scontrol.txt"\n',
    "mail": '#!/usr/bin/env bash\n(echo "$@"; cat) >>"$WORK/mail.txt"\n'}


def go(folder, name, plan, edits=(), array=None):
    """Runs a script as often as it asks for, `plan` saying the exit code, new checkpoint and status of each start of the
    program. Gives exit codes of the script, the words of each srun and what the last start printed."""
    for program, text in STAND_INS.items():
        (folder / program).write_text(text)
        (folder / program).chmod(0o755)
    (folder / "plan.txt").write_text("".join(f"{code} {step} {status}\n" for code, step, status in plan))
    text = (SOURCE / "jobscripts" / f"{name}.sbatch").read_text()
    for old, new in (('program="', 'program="/p/dendrift"  # "'), ('output="', f'output="{folder}/out"  # "'), *edits):
        text, count = re.subn(rf"^{re.escape(old)}", lambda _: new, text, flags=re.M)
        require(count == 1, f"{name}: {count} lines begin with {old}")
    (folder / "job").write_text(text)
    environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "WORK": str(folder), "SLURM_JOB_ID": "7",
                   "SLURM_CPUS_PER_TASK": "2", "SLURM_SUBMIT_DIR": str(folder), "SLURM_JOB_NODELIST": "n1",
                   "SLURM_JOB_NUM_NODES": "2", "SLURM_NTASKS_PER_NODE": "4"}
    if array is not None:
        environment.update(SLURM_ARRAY_TASK_ID=str(array), SLURM_ARRAY_TASK_MIN="0", SLURM_ARRAY_TASK_COUNT="4")
    codes, requeued = [], 0
    while True:
        environment["SLURM_RESTART_COUNT"] = str(len(codes))
        done = subprocess.run(["bash", folder / "job"], env=environment, capture_output=True, text=True, cwd=folder)
        codes.append(done.returncode)
        orders = (folder / "scontrol.txt").read_text() if (folder / "scontrol.txt").exists() else ""
        require(set(orders.split("\n")) <= {"requeue 7", ""}, f"{name}: scontrol {orders}")
        if orders.count("requeue") == requeued:
            break
        requeued += 1
        if len(codes) > 9:
            fail(f"{name}: queued again without end")
    words = (folder / "srun.txt").read_text().split("\n")[:-1] if (folder / "srun.txt").exists() else []
    return codes, words, done.stdout + done.stderr


def check_requeue(name, array=None):
    where = "/case_1" if name == "sweep" else ""
    folder = scratch()
    codes, words, _ = go(folder, name, [(75, 10, "stopped"), (75, 20, "stopped"), (0, "-", "done")], array=array)
    require(codes == [75, 75, 0], f"{name}: {codes}")
    restart = f"--restart {folder}/out{where}"
    require([restart in w for w in words] == [False, True, True], f"{name}: {words}")
    require(all("--cpus-per-task=2" in w and f"output.dir={folder}/out{where}" in w for w in words), f"{name}: {words}")
    for code in (1, 2, 3, 4, 137):
        codes, _, _ = go(scratch(), name, [(code, 10, "failed")], array=array)
        require(codes == [code], f"{name}: exit code {code} gives {codes}")
    tries = re.search(r"^max_tries=\d+", (SOURCE / f"jobscripts/{name}.sbatch").read_text(), re.M)[0]
    codes, _, _ = go(scratch(), name, [(75, n, "stopped") for n in range(9)], [(tries, "max_tries=3")], array)
    require(codes == [75] * 3, f"{name}: max_tries=3 gives {codes}")
    folder = scratch()
    (folder / "forbidden").touch()
    codes, _, text = go(folder, name, [(75, 5, "stopped")], array=array)
    require(codes == [75] and "could not be queued again" in text, f"{name}, no requeue: {codes} {text}")


def check_until_done():
    check_requeue("until_done")
    for plan, codes, reason in (
            ([(75, 5, "stopped"), (75, "-", "stopped")], [75, 75], "given up: stopped without a new checkpoint"),
            ([(75, "-", "stopped")], [75], "given up: stopped without a new checkpoint"),
            ([(75, 9999999, "stopped"), (75, 10000000, "stopped"), (0, "-", "done")], [75, 75, 0], "done"),
            ([(0, 5, "stopped")], [1], "manifest.json does not say done"),
            ([(75, 5, "stopped"), (3, "-", "failed")], [75, 3], "given up: numerical failure (exit code 3)"),
            ([(9, "-", "failed")], [9], "given up: exit code 9")):
        folder = scratch()
        found, _, text = go(folder, "until_done", plan, [('mail_to=""', 'mail_to="me@example.org"')])
        mail = (folder / "mail.txt").read_text()
        require(found == codes and reason in text, f"until_done: {codes}, '{reason}' expected: {found} {text}")
        require(reason in (folder / "out/until_done.log").read_text() and "me@example.org" in mail and reason in mail,
                f"until_done: log and mail should say '{reason}': {mail}")
    folder = scratch()  # submitted again by hand
    (folder / "out").mkdir()
    (folder / "out/chk_0000003.h5").touch()
    codes, words, _ = go(folder, "until_done", [(0, "-", "done")])
    require(codes == [0] and f"--restart {folder}/out" in words[0], f"until_done with a checkpoint: {codes} {words}")


def check_scaling():
    for name in ("strong_scaling", "weak_scaling"):
        codes, words, _ = go(scratch(), name, [(0, "-", "done")] * 3, array=4)
        require(codes == [0] and len(words) == 3 and all("--nodes=1 --ntasks=4" in w for w in words), f"{name}: {words}")
        require(len({w.split("output.dir=")[1] for w in words}) == 3, f"{name}: runs share a folder: {words}")
        codes, words, text = go(scratch(), name, [], array=9)
        require(codes == [2] and not words and "found: 9" in text, f"{name}: 9 ranks on 2 nodes of 4: {codes} {text}")
        codes, words, _ = go(scratch(), name, [(3, "-", "failed")], array=4)
        require(codes == [3] and len(words) == 1, f"{name}: goes on after a failure: {codes} {words}")
    require("--nodes=2 --ntasks=8" in go(scratch(), "strong_scaling", [(0, "-", "done")] * 3, array=8)[1][0], "8 ranks")
    codes, words, text = go(scratch(), "sweep", [], array=4)
    require(codes == [2] and not words and "found: 4" in text, f"sweep: an index without a case: {codes} {text}")


require(len(SCRIPTS) == 6, f"{len(SCRIPTS)} job scripts")
count = sum(len(check_text(path)) for path in SCRIPTS)
say(f"{len(SCRIPTS)} job scripts: syntax, {count} options of sbatch, lines to edit")
for script in ("one_node", "many_node"):
    check_requeue(script)
check_requeue("sweep", array=1)
check_until_done()
check_scaling()
say("queued again on code 75 only, within bounds; --restart; reasons; scaling")

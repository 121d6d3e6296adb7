#!/usr/bin/python3
"""Starts a Slurm of its own on this machine, submits every script of jobscripts/ with small inputs, checks the results.

    slurm_test.py [PROGRAMS] [--quick] [--log FILE] [--keep]

PROGRAMS is the folder of dendrift, dendrift2d and dendrift3d (default: build/release). Installs Debian's slurm-wlm and
munge if they are missing and it is root. The Slurm has three pretended nodes of eight pretended CPUs, a folder and ports
of its own; only what was started here is ended. The scripts run as they are but for the lines above their
"Nothing to edit below" and options of sbatch.

Limits: with --quick the test sends SIGUSR1 (scancel --signal) when a run has done a part of its steps, which is what
Slurm does before a time limit. Without --quick, also Slurm itself does so, with time limits of one minute, and a node
dies in the middle of a run.

Exit codes: 0 passed, 1 failed, 77 a Slurm cannot be started here.
"""
import argparse
import getpass
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = ROOT / "jobscripts"
NODES = ("n1", "n2", "n3")
CPUS = 8              # pretended, of each node
REQUEUE_WAIT = 6      # s until Slurm starts a requeued job again; 120 by default (slurm.conf, cred_expire)
STEPS = 2000          # of the runs below
GROWTH = """
[run]
end_time_tau0 = 100000
max_steps = {steps}
[mesh]
dim = 2
size_W0 = [128, 128]
[[seed]]
position_W0 = [64, 64]
radius_W0 = 8
angle_deg = 20
[output]
diagnostics_every_tau0 = 2
checkpoint_every_steps = 100
"""
SETTLING = """
[run]
end_time_tau0 = 100000
max_steps = {steps}
[mesh]
dim = 2
size_W0 = [128, 192]
[[seed]]
position_W0 = [64, 140]
radius_W0 = 8
angle_deg = 20
[flow]
coarser_levels = 1
[output]
diagnostics_every_tau0 = 1
checkpoint_every_steps = 20
"""


class CannotStart(Exception):
    """Why there is no Slurm, in one line."""


class Log:
    def __init__(self, path):
        self.file = open(path, "w", encoding="utf-8") if path else None
        self.start, self.hidden, self.failures = time.monotonic(), {}, 0

    def say(self, text):
        for secret, name in self.hidden.items():
            text = text.replace(secret, name)
        text = f"{time.monotonic() - self.start:5.0f} s  {text}"
        for file in filter(None, (sys.stdout, self.file)):
            print(text, file=file, flush=True)

    def check(self, condition, text, found=""):
        self.say(f"{'pass' if condition else 'FAIL'}  {text}{'' if condition or found == '' else f'; found: {found}'}")
        self.failures += not condition


def free_ports(count):
    sockets = [socket.socket() for _ in range(count)]
    for s in sockets:
        s.bind(("127.0.0.1", 0))
    ports = [s.getsockname()[1] for s in sockets]
    for s in sockets:
        s.close()
    return ports


class Slurm:
    """munged, slurmctld and a slurmd for each node, as children of this process."""

    def __init__(self, folder, log):
        self.folder, self.log, self.daemons = folder, log, []
        os.environ["PATH"] += ":/usr/sbin:/sbin"
        needed = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol")
        missing = [name for name in needed if not shutil.which(name)]
        if missing:
            raise CannotStart(f"no {', '.join(missing)}; tools/setup_debian.sh slurm installs them")
        for name in ("control", "run", "log", "bin", *(f"{kind}_{n}" for n in NODES for kind in ("spool", "tmp"))):
            (folder / name).mkdir()
        folder.chmod(0o755)  # munge does not take a socket below a folder that others may not enter
        key = folder / "munge.key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o600)
        self.mails = folder / "mails.txt"  # of Slurm, and of the `mail` that the scripts find
        for name in ("slurm_mail", "mail"):
            program = folder / "bin" / name
            program.write_text(f'#!/bin/sh\n(echo "{name}: $*"; cat) >>{shlex.quote(str(self.mails))}\n')
            program.chmod(0o755)
        self.mails.touch()
        os.environ["PATH"] = f"{folder / 'bin'}:{os.environ['PATH']}"
        os.environ["SLURM_CONF"] = str(self.write_conf())
        try:
            self.start()
        except BaseException:
            self.stop()
            raise

    def write_conf(self):
        user, host, (control, *ports) = getpass.getuser(), socket.gethostname().split(".")[0], free_ports(1 + len(NODES))
        settings = {
            "ClusterName": "dendrift_test", "SlurmctldHost": f"{host}(127.0.0.1)", "SlurmctldPort": control,
            "SlurmUser": user, "SlurmdUser": user, "AuthType": "auth/munge",
            "AuthInfo": f"socket={self.folder}/run/munge,cred_expire={REQUEUE_WAIT}",
            "StateSaveLocation": self.folder / "control", "SlurmdSpoolDir": self.folder / "spool_%n",
            "TmpFS": self.folder / "tmp_%n",  # of PMIx as well: nodes on one machine need one each
            "SlurmctldPidFile": self.folder / "run/slurmctld.pid", "SlurmdPidFile": self.folder / "run/slurmd_%n.pid",
            "SlurmctldLogFile": self.folder / "log/slurmctld", "SlurmdLogFile": self.folder / "log/slurmd_%n",
            "MailProg": self.folder / "bin/slurm_mail", "ProctrackType": "proctrack/linuxproc",
            "TaskPlugin": "task/none", "SelectType": "select/cons_tres", "SelectTypeParameters": "CR_Core",
            "SlurmdParameters": "config_overrides",  # believe the numbers of CPUs below
            "SchedulerParameters": "sched_min_interval=100000,bf_interval=1,batch_sched_delay=0",
            "ReturnToService": 2, "KillWait": 5, "MinJobAge": 100000}
        lines = [f"{name}={value}" for name, value in settings.items()]
        lines += [f"NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={CPUS} Boards=1 "
                  f"SocketsPerBoard=1 CoresPerSocket={CPUS} ThreadsPerCore=1 State=UNKNOWN"
                  for node, port in zip(NODES, ports)]
        lines.append(f"PartitionName=all Nodes={','.join(NODES)} Default=YES MaxTime=INFINITE State=UP")
        conf = self.folder / "slurm.conf"
        conf.write_text("\n".join(map(str, lines)) + "\n")
        return conf

    def daemon(self, name, *command):
        with open(self.folder / "log" / f"{name}.out", "w") as out:
            self.daemons.append((name, subprocess.Popen(list(map(str, command)), stdin=subprocess.DEVNULL, stdout=out,
                                                        stderr=out, start_new_session=True)))

    def start(self):
        run, out = self.folder / "run", self.folder / "log"
        self.daemon("munged", "munged", "--foreground", "--force", f"--key-file={self.folder / 'munge.key'}",
                    f"--socket={run / 'munge'}", f"--pid-file={run / 'munged.pid'}", f"--log-file={out / 'munged'}",
                    f"--seed-file={run / 'munge.seed'}")
        self.await_("munged", lambda: (run / "munge").exists())
        self.daemon("slurmctld", "slurmctld", "-D", "-c")
        for node in NODES:
            self.start_node(node)
        self.await_("nodes", lambda: ask("sinfo", "-h", "-N", "-o", "%t", must=False).split() == ["idle"] * len(NODES))

    def start_node(self, node):
        self.daemon(f"slurmd_{node}", "slurmd", "-D", "-N", node)

    def kill(self, name):
        process = dict(self.daemons)[name]
        self.daemons.remove((name, process))
        process.kill()
        process.wait()

    def await_(self, what, condition, seconds=30):
        end = time.monotonic() + seconds
        while not condition():
            gone = [name for name, process in self.daemons if process.poll() is not None]
            if gone or time.monotonic() > end:
                texts = [p.read_text(errors="replace")[-300:] for p in (self.folder / "log").iterdir()
                         if not gone or p.name.startswith(gone[0])]
                reason = f"{gone[0]} ended" if gone else f"{what}: not ready after {seconds} s"
                raise CannotStart(f"{reason}: {' | '.join(filter(None, (' '.join(t.split()) for t in texts)))}")
            time.sleep(0.1)

    def stop(self):
        running = ask("squeue", "-h", "-o", "%A", must=False).split()
        if running:
            ask("scancel", *running, must=False)
            end = time.monotonic() + 20
            while ask("squeue", "-h", "-o", "%A", must=False).split() and time.monotonic() < end:
                time.sleep(0.2)
        for name, process in reversed(self.daemons):
            process.terminate()
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.daemons = []


def ask(*command, must=True, cwd=None):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, cwd=cwd)
    if must and done.returncode != 0:
        raise RuntimeError(f"{' '.join(map(str, command))}: exit code {done.returncode}: {done.stdout}{done.stderr}")
    return done.stdout


def edited(name, **values):
    """The text of a job script with other values in the lines to edit: a text, a number, a list or a dict."""
    def word(value):
        return '"' + re.sub(r'(["\\`])', r"\\\1", str(value)) + '"'

    head, mark, rest = (SCRIPTS / f"{name}.sbatch").read_text().partition("\n# Nothing to edit below")
    if not mark:
        raise RuntimeError(f"{name}.sbatch: no line 'Nothing to edit below'")
    for key, value in values.items():
        if isinstance(value, dict):
            new = f"declare -A {key}=(" + " ".join(f"[{k}]={word(v)}" for k, v in value.items()) + ")"
        elif isinstance(value, list):
            new = f"{key}=(" + " ".join(map(word, value)) + ")"
        else:
            new = f"{key}={value if isinstance(value, int) else word(value)}"
        old = r"\(.*?\)(?=[ ]*(?:#[^\n]*)?$)" if isinstance(value, (list, dict)) else r"[^\n]*"
        head, count = re.subn(rf"^(?:declare -A )?{key}={old}", lambda _: new, head, flags=re.M | re.S)
        if count != 1:
            raise RuntimeError(f"{name}.sbatch: {count} lines '{key}=' to edit, 1 expected")
    return head + mark + rest


class Bench:
    """Submits scripts, waits for jobs, compares runs."""

    def __init__(self, folder, programs, mpi, log):
        self.folder, self.programs, self.mpi, self.log, self.count = folder, programs, mpi, log, 0

    def scene(self, name, text, steps):
        path = self.folder / f"{name}.toml"
        path.write_text(text.format(steps=steps))
        return path

    def submit(self, name, options, **values):
        """The number of the job."""
        self.count += 1
        script = self.folder / f"{self.count:02d}_{name}.sbatch"
        script.write_text(edited(name, program=self.programs / "dendrift", mpi=self.mpi, **values))
        job = ask("sbatch", "--parsable", f"--output={script.with_suffix('')}_%j.log", *options.split(), script,
                  cwd=self.folder).strip()
        self.log.say(f"      job {job}: {name}.sbatch {options}")
        return job

    def state(self, job):
        """One dict of scontrol's fields for a job, or a list of them for the elements of an array."""
        lines = ask("scontrol", "-o", "show", "job", job, must=False).splitlines()
        return [dict(re.findall(r"(\w+)=(\S*)", line)) for line in lines]

    def ended(self, job):
        """The jobs, if all have ended, in the order of the array."""
        jobs = [j for j in self.state(job) if "-" not in j.get("ArrayTaskId", "")]
        over = ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "OUT_OF_MEMORY")
        waiting = any("-" in j.get("ArrayTaskId", "") or j["JobState"] not in over for j in self.state(job))
        return None if waiting or not jobs else sorted(jobs, key=lambda j: int(j.get("ArrayTaskId", 0)))

    def wait(self, *jobs, seconds=400, meanwhile=lambda: None):
        end = time.monotonic() + seconds
        while True:
            found = [self.ended(job) for job in jobs]
            if all(found):
                return [j for group in found for j in group]
            if time.monotonic() > end:
                raise RuntimeError(f"jobs {' '.join(jobs)} did not end in {seconds} s: {ask('squeue')}")
            for _ in range(20):
                meanwhile()
                time.sleep(0.05)

    def log_of(self, job):
        return "".join(p.read_text() for p in sorted(self.folder.glob(f"*_{job}.log")))


class Limits:
    """Sends SIGUSR1 to the steps of a job once in each of its first starts, when its run has done as many steps as the
    list says and some since the start: without them it would stop where it began."""

    def __init__(self, bench, job, output, steps):
        self.bench, self.job, self.output, self.steps, self.sent = bench, job, output, list(steps), []

    def __call__(self):
        number, done = len(self.sent), last_step(self.output)
        if number < len(self.steps) and done >= self.steps[number] and done > step_of(newest(self.output)):
            state = self.bench.state(self.job)[0]
            if (state["JobState"], int(state["Restarts"])) == ("RUNNING", number) and \
                    manifest(self.output).get("status") == "running":
                ask("scancel", "--signal=USR1", self.job)
                self.sent.append(done)


def manifest(folder):
    try:
        return json.loads((folder / "manifest.json").read_text())
    except (OSError, ValueError):
        return {}


def last_step(folder):
    try:
        return int((folder / "diagnostics.csv").read_text().rpartition("\n")[0].rpartition("\n")[2].split(",")[0])
    except (OSError, ValueError):
        return -1


def newest(folder):
    return max((p.name for p in folder.glob("chk_*.h5")), default="none")


def step_of(checkpoint):
    return -1 if checkpoint == "none" else int(re.search(r"\d+", checkpoint)[0])


def contents(path):
    """Everything numerical in an HDF5 file, as bytes; not the texts that name folders and ranks, nor which rank
    had which block (the array of all components of a plotfile has it, too: its VTKHDF face names them one by one)."""
    found = {}

    def visit(name, item):
        other = name.rpartition("/")[2] in ("rank", "Processors", "data:datatype=0", "input", "origin")
        if isinstance(item, h5py.Dataset) and not other and item.dtype.kind in "iufV":
            found[name] = (item.shape, str(item.dtype), item[()].tobytes())

    with h5py.File(path) as file:
        file.visititems(visit)
        for owner in filter(lambda o: o in file, ("/", "numbers")):
            found.update({f"{owner} {k}": np.asarray(v).tobytes() for k, v in file[owner].attrs.items()
                          if np.asarray(v).dtype.kind in "iuf"})
    return found


def lines_of(path):
    """A CSV file without its column of times on the clock."""
    rows = [line.split(",") for line in path.read_text().splitlines()]
    wall = rows[0].index("wall_s") if "wall_s" in rows[0] else None
    return [[value for i, value in enumerate(row) if i != wall] for row in rows]


def compare(a, b):
    """What differs between two runs, and in words what was compared."""
    wrong, counts = [], []
    if newest(a) == "none" or newest(a) != newest(b):
        return [f"newest checkpoints {newest(a)} and {newest(b)}"], ""
    pairs = [(a / newest(a), b / newest(b))]
    plots = [max(folder.glob("plt_*.hdf")) for folder in (a, b)]
    if plots[0].name != plots[1].name:
        wrong.append(f"last plotfiles {plots[0].name} and {plots[1].name}")
    else:
        pairs.append(tuple(plots))
    for one, other in pairs:
        first, second = contents(one), contents(other)
        wrong += [f"{one.name}: {k}" for k in sorted(first.keys() | second.keys()) if first.get(k) != second.get(k)]
        counts.append(f"{one.name} ({len(first)} arrays and numbers, {one.stat().st_size} bytes)")
    for name in ("diagnostics.csv", "tips.csv", "grains.csv"):
        if (a / name).exists() or (b / name).exists():
            first, second = lines_of(a / name), lines_of(b / name)
            if first != second:
                wrong.append(f"{name}: {len(first)} and {len(second)} lines")
            counts.append(f"{name} ({len(first)} lines)")
    return wrong, ", ".join(counts)


def end_of(job):
    return job["JobState"], int(job["ExitCode"].split(":")[0]), int(job["Restarts"])


def scripts(bench, log, mails):
    """All scripts; limits by scancel --signal."""
    scene, work = bench.scene("growth", GROWTH, STEPS), bench.folder
    small = "--nodes=1 --ntasks-per-node=2 --cpus-per-task=1 --time=30"
    out = {name: work / "out" / name for name in
           ("one_node", "many_node", "until_done", "strong", "weak", "sweep", "code_2", "code_3", "code_4",
            "no_progress", "two_tries")}
    flow = bench.scene("flow", SETTLING, 40)

    one = bench.submit("one_node", small, input=scene, output=out["one_node"])
    until = bench.submit("until_done", small, input=scene, output=out["until_done"], mail_to="user@example.org")
    sweep = bench.submit("sweep", small + " --array=0-3%2", input=scene, output=out["sweep"],
                         cases=["run.max_steps=300", "alloy.supersaturation=0.25 run.max_steps=400",
                                "alloy.supersaturation=25"])
    many = bench.submit("many_node", "--nodes=2 --ntasks-per-node=2 --cpus-per-task=2 --time=30", input=scene,
                        output=out["many_node"])
    limits = [Limits(bench, until, out["until_done"], [STEPS * k // 8 for k in (1, 2, 3)]),
              Limits(bench, many, out["many_node"], [STEPS // 4])]
    (out["code_4"] / "diagnostics.csv").mkdir(parents=True)  # a folder in the place of a file
    stopped = {
        "code_2": bench.submit("until_done", small, input=scene, output=out["code_2"],
                               overrides=["alloy.supersaturation=25"], mail_to="user@example.org"),
        "code_3": bench.submit("until_done", small, input=flow, output=out["code_3"],
                               overrides=["flow.max_iterations=1"]),
        "code_4": bench.submit("until_done", small, input=scene, output=out["code_4"]),
        "no_progress": bench.submit("until_done", small, input=scene, output=out["no_progress"],
                                    overrides=["run.wall_clock_limit_s=1e-6"]),
        "two_tries": bench.submit("until_done", small, input=scene, output=out["two_tries"], max_tries=2,
                                  overrides=["run.max_steps=10000000"])}
    limits.append(Limits(bench, stopped["two_tries"], out["two_tries"], [50, 400]))
    strong = bench.submit("strong_scaling", "--nodes=1 --ntasks-per-node=4 --array=1,2,4,5%1 --time=30", input=scene,
                          output=out["strong"], overrides=["run.max_steps=60"], repeats=2)
    weak = bench.submit("weak_scaling", "--nodes=2 --ntasks-per-node=2 --array=1,4,2%1 --time=30", input=scene,
                        output=out["weak"], overrides=["run.max_steps=60"], repeats=1,
                        size={1: "mesh.size_W0=[128,128]",
                              4: "mesh.size_W0=[256,256] seeds.count=3 seeds.radius_W0=8"})
    bench.wait(one, until, sweep, many, strong, weak, *stopped.values(),
               meanwhile=lambda: [limit() for limit in limits])

    job, = bench.wait(one)
    found = manifest(out["one_node"])
    log.check(end_of(job) == ("COMPLETED", 0, 0), "one_node: exit code 0, never requeued", end_of(job))
    log.check((found.get("status"), found.get("ranks"), found.get("steps")) == ("done", 2, STEPS),
              f"one_node: manifest says done, 2 ranks, {STEPS} steps", found.get("status"))

    job, = bench.wait(many)
    found = manifest(out["many_node"])
    log.check(end_of(job) == ("COMPLETED", 0, 1), "many_node: signalled once, requeued once, exit code 0", end_of(job))
    log.check((found.get("status"), found.get("ranks"), found.get("threads"), job["NumNodes"]) ==
              ("done", 4, 2, "2"), "many_node: done on 4 ranks of 2 threads on two nodes", found)
    wrong, what = compare(out["one_node"], out["many_node"])
    log.check(not wrong, f"many_node, restarted: same as one_node: {what}", wrong)

    job, = bench.wait(until)
    log.check(end_of(job) == ("COMPLETED", 0, 3), f"until_done: signalled after steps {limits[0].sent}, 3 times "
              "requeued, exit code 0 in the fourth try", end_of(job))
    wrong, what = compare(out["one_node"], out["until_done"])
    log.check(not wrong, f"until_done: same as the uninterrupted run: {what}", wrong)
    diary = (out["until_done"] / "until_done.log").read_text()
    log.check(diary.count("queued again") == 3 and diary.rstrip().endswith("try 4 of 20: done"),
              "until_done.log: three times 'queued again', then 'done'", diary)

    jobs = bench.wait(sweep)
    log.check([end_of(j)[:2] for j in jobs] == [("COMPLETED", 0)] * 2 + [("FAILED", 2)] * 2,
              "sweep: two cases done; a bad value and an index without a case end with code 2", list(map(end_of, jobs)))
    cases = [manifest(out["sweep"] / f"case_{n}") for n in range(2)]
    log.check([(c.get("status"), c.get("steps"), "supersaturation = 0.25" in c.get("input", "")) for c in cases] ==
              [("done", 300, False), ("done", 400, True)], "sweep: each case with its overrides")

    for name, code, restarts, reason in (
            ("code_2", 2, 0, "given up: bad input (exit code 2)"),
            ("code_3", 3, 0, "given up: numerical failure (exit code 3)"),
            ("code_4", 4, 0, "given up: a file could not be read or written (exit code 4)"),
            ("no_progress", 75, 1, "given up: stopped without a new checkpoint"),
            ("two_tries", 75, 1, "given up: not done after 2 tries")):
        job, = bench.wait(stopped[name])
        text = (out[name] / "until_done.log").read_text()
        log.check(end_of(job) == ("FAILED", code, restarts) and reason in text,
                  f"until_done: ends with code {code} after {restarts + 1} start{'s' if restarts else ''}: '{reason}'",
                  f"{end_of(job)}: {text}")
    mailed = mails.read_text()
    log.check(all(f"mail: -s dendrift job {job}: {why}" in mailed for job, why in
                  ((until, "done user@"), (stopped["code_2"], "given up: bad input"))),
              "until_done: mails its reason", mailed)
    log.check(f"Job_id={stopped['code_3']}" in mailed, "Slurm mails that a job failed", mailed)

    for name, job, expected, rows in (("strong", strong, [0, 0, 0, 2], ["1", "2", "4"]),
                                      ("weak", weak, [0, 2, 0], ["1", "4"])):
        jobs = bench.wait(job)
        log.check([end_of(j)[1] for j in jobs] == expected,
                  f"{name}_scaling: exit codes {expected} of array indices {[j['ArrayTaskId'] for j in jobs]}; "
                  "2: a number of ranks without a place", [end_of(j) for j in jobs])
        text = ask(sys.executable, ROOT / "tools/scaling.py", out[name])
        table = [line.split(",") for line in (out[name] / "scaling.csv").read_text().splitlines()[1:]]
        log.check([row[:2] for row in table] == [[name, n] for n in rows], f"scaling.py: {name}, rows of {rows} ranks",
                  table)
        for line in text.splitlines():
            log.say(f"        {line}")


def slurms_own_limit(bench, log):
    """Time limits of one minute, with flow; the end is set once three limits have passed."""
    scene, output = bench.scene("settling", SETTLING, 10**7), bench.folder / "out/limit"
    job = bench.submit("until_done", "--nodes=1 --ntasks-per-node=2 --time=1 --signal=USR1@20", input=scene,
                       output=output)
    end = []

    def set_the_end():
        if not end and int(bench.state(job)[0]["Restarts"]) >= 3:
            end.append(step_of(newest(output)) + 50)
            bench.scene("settling", SETTLING, end[0])

    found, = bench.wait(job, seconds=900, meanwhile=set_the_end)
    diary = (output / "until_done.log").read_text()
    for line in diary.splitlines():
        log.say(f"        {line.partition('  ')[2]}")
    log.check(end_of(found)[:2] == ("COMPLETED", 0) and end_of(found)[2] >= 3 and diary.count("queued again") >= 3,
              f"until_done, --time=1 --signal=USR1@20: Slurm's own signal, {end_of(found)[2]} limits, exit code 0",
              end_of(found))
    reference = bench.folder / "out/no_limit"
    bench.wait(bench.submit("one_node", "--nodes=1 --ntasks-per-node=2 --time=30", input=scene, output=reference))
    wrong, what = compare(reference, output)
    log.check(not wrong, f"the same as without limits, {end} steps: {what}", wrong)


def kill_everything(slurm, job, node):
    """What a node does that loses its power: SIGKILL to its slurmd, to the parts of Slurm that watch the job, and to
    the job itself."""
    mine, conf = {}, f"SLURM_CONF={slurm.folder / 'slurm.conf'}".encode()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            settings = (path / "environ").read_bytes().split(b"\0")
            if conf in settings and f"SLURM_JOB_ID={job}".encode() in settings:
                mine[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            pass
    watchers = {p for p in mine.values() if Path(f"/proc/{p}/comm").read_text().startswith("slurmstepd")}
    slurm.kill(f"slurmd_{node}")
    for pid in [*watchers, *mine]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
    return len(watchers) + len(mine)


def failing_node(bench, slurm, log):
    """A node dies under a run: Slurm requeues the job, which goes on elsewhere from its newest checkpoint."""
    scene, output = bench.scene("growth", GROWTH, STEPS), bench.folder / "out/failing_node"
    job = bench.submit("until_done", "--nodes=1 --ntasks-per-node=2 --time=30", input=scene, output=output)
    node = []

    def take_it_down():
        if not node and last_step(output) >= STEPS // 4 and newest(output) != "none":
            state = bench.state(job)[0]
            node.extend([state["NodeList"], kill_everything(slurm, job, state["NodeList"]), newest(output)])
            ask("scontrol", "update", f"nodename={node[0]}", "state=down", "reason=test")  # instead of its timeout

    found, = bench.wait(job, meanwhile=take_it_down)
    slurm.start_node(node[0])
    diary = (output / "until_done.log").read_text()
    log.check(end_of(found) == ("COMPLETED", 0, 1) and f"try 2 of 20: starts from {node[2]} on" in diary
              and found["NodeList"] != node[0],
              f"until_done, node {node[0]} dies ({node[1]} processes killed): requeued by Slurm, went on from {node[2]} "
              f"on {found['NodeList']}, exit code 0", f"{end_of(found)}: {diary}")
    wrong, what = compare(bench.folder / "out/one_node", output)
    log.check(not wrong, f"the same as on a node that does not fail: {what}", wrong)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("programs", metavar="PROGRAMS", type=Path, nargs="?", default=ROOT / "build/release")
    parser.add_argument("--quick", action="store_true", help="no time limits of Slurm's own, no dying node")
    parser.add_argument("--no-install", action="store_true", help="do not install packages")
    parser.add_argument("--log", type=Path, metavar="FILE", help="a copy of what is printed")
    parser.add_argument("--keep", action="store_true", help="keep the folder of the test")
    opt = parser.parse_args()
    programs = opt.programs.resolve()
    for name in ("dendrift", "dendrift2d"):
        if not (programs / name).is_file():
            parser.error(f"no {name} in {programs}: build it, or name the folder of the programs")
    if not opt.no_install and os.geteuid() == 0 and not shutil.which("slurmctld"):
        subprocess.run([ROOT / "tools/setup_debian.sh", "slurm"], check=True)

    log = Log(opt.log)
    folder = Path(tempfile.mkdtemp(prefix="dendrift_slurm_"))
    log.hidden = {str(folder): "WORK", str(programs): "PROGRAMS", str(ROOT): "SOURCE", socket.gethostname(): "HOST"}
    # Settings for MPI of whoever calls may not suit srun. More ranks than cores must let each other work; Open MPI's
    # shared memory mixes up two nodes of one host name.
    for name in [n for n in os.environ if n.startswith(("OMPI_", "PMIX_", "SLURM_", "SBATCH_", "OMP_"))]:
        del os.environ[name]
    os.environ.update(OMPI_MCA_mpi_yield_when_idle="1", OMPI_MCA_pml="ob1", OMPI_MCA_btl="self,tcp",
                      OMPI_MCA_osc="^ucx", OMP_WAIT_POLICY="passive")

    def interrupted(*_):
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupted)
    slurm = None
    try:
        slurm = Slurm(folder, log)
        kinds = subprocess.run(["srun", "--mpi=list"], capture_output=True, text=True)
        kinds = (kinds.stdout + kinds.stderr).split()
        mpi = "pmix" if "pmix" in kinds else "pmi2"
        log.say(f"{ask('sinfo', '--version').strip()}, {len(NODES)} pretended nodes of {CPUS} pretended CPUs, "
                f"srun --mpi={mpi}; {os.cpu_count()} real CPUs")
        log.say(ask(programs / "dendrift", "--version").splitlines()[0])
        log.say("Limits by scancel --signal=USR1" + ("" if opt.quick else "; then Slurm's own of one minute") +
                f". Requeued jobs wait {REQUEUE_WAIT} s (cred_expire).")
        bench = Bench(folder, programs, mpi, log)
        scripts(bench, log, slurm.mails)
        if not opt.quick:
            failing_node(bench, slurm, log)
            slurms_own_limit(bench, log)
    except CannotStart as reason:
        log.say(f"skipped: {reason}")
        return 77
    except RuntimeError as problem:
        log.check(False, str(problem))
    finally:
        if slurm:
            slurm.stop()
        if opt.keep or log.failures:
            print(f"kept: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    log.say(f"{log.failures} failed" if log.failures else "all passed")
    return 1 if log.failures else 0


if __name__ == "__main__":
    sys.exit(main())

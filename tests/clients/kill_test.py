#!/usr/bin/python3
"""kill -9 of one rank or of both at random moments: every restart must go on, and the end must be that of a run that nothing
disturbed: the last checkpoint bit by bit, every line of the CSV files but for wall-clock times, the list of plotfiles.
What others left locked that were killed elsewhere holds up nobody.
A few kills as a test; tools/kill_test.py does hundreds. Arguments: BUILD SOURCE [KILLS [SEED]]"""
import collections
import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import checkpoint_bits, command_line, differences, environment, read_csv, require, run, say, scratch

# Tiny steps, a change of the mesh every other one, and something written in nearly every one.
LAST = 240
SCENE = f"""
[run]
end_time_tau0 = 1000
max_steps = {LAST + 1}
[mesh]
dim = 2
size_W0 = [64, 64]
root_blocks = [1, 1]
levels = 4
block_cells = 8
max_regrid_steps = 2
[alloy]
supersaturation = 0.6
[[seed]]
position_W0 = [0, 0]
radius_W0 = 6
[phase_field]
max_dt_tau0 = 0.05
[output]
dir = "run"
diagnostics_every_tau0 = 0.1
plot_every_tau0 = 0.15
checkpoint_every_steps = 5
"""
RANKS = 2
START = "the start"


class Run:
    """A run on its way, and its ranks."""

    def __init__(self, folder, restart):
        words = ["--restart", "run"] if restart else []
        self.out, self.folder = folder / "run", folder
        self.launcher_hung = False
        self.log = open(folder / "log", "w+")
        self.process = subprocess.Popen(command_line("scene.toml", *words, ranks=RANKS), cwd=folder, env=environment(),
                                        stdin=subprocess.DEVNULL, stdout=self.log, stderr=subprocess.STDOUT)

    def found(self):
        """Process ids of the ranks."""
        found = []
        for task in Path(f"/proc/{self.process.pid}/task").glob("*/children"):
            try:
                children = [int(p) for p in task.read_text().split()]
                found += [p for p in children if Path(f"/proc/{p}/comm").read_text().startswith("dendrift")]
            except OSError:
                pass
        return found

    def ranks(self):
        """The same as soon as all are there, none before."""
        found = self.found()
        return found if len(found) == RANKS else []

    def over(self):
        return self.process.poll() is not None

    def wait(self, launcher_may_hang=False):
        """To the end. Open MPI's mpirun can wait forever for a rank that was killed while it connected, before any line of
        ours has run; that is not what is tested here."""
        try:
            self.process.wait(timeout=20 if launcher_may_hang else 120)
        except subprocess.TimeoutExpired:
            for pid in self.found():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self.process.kill()
            self.process.wait()
            require(launcher_may_hang, f"no end after 120 s: {self.text()}")
            self.launcher_hung = True
        return self.text()

    def text(self):
        self.log.seek(0)
        return self.log.read()


def parts(out):
    try:
        return [n for n in os.listdir(out) if n.endswith(".part")]
    except OSError:
        return []


def moment(run_now, chance, seconds):
    """Waits for the moment of the next kill: any, or while a file of some kind is being written. False: the run is over."""
    aim = chance.choice(["any", "any", "chk_", "plt_0"])
    end = time.monotonic() + 120
    while not run_now.ranks():
        if run_now.over():
            return False
        require(time.monotonic() < end, f"the ranks do not start: {run_now.text()}")
        time.sleep(0.005)
    time.sleep(chance.uniform(0, seconds))
    while aim != "any" and not run_now.over() and not any(n.startswith(aim) for n in parts(run_now.out)):
        pass
    time.sleep(chance.choice([0, 0, chance.uniform(0, 0.004)]))
    return not run_now.over()


def kill(run_now, chance):
    """What was interrupted, and who was killed; nothing if the run had come to its end."""
    victims = run_now.ranks()
    if not victims:
        return None
    if chance.random() < 0.5:
        victims = [chance.choice(victims)]
    try:
        for pid in victims:
            os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return None
    torn = parts(run_now.out)  # rank 0 may have got on by an instant if it was not the victim
    kinds = {"chk_": "a checkpoint", "plt_": "a plotfile", "plt.": "the list of plotfiles", "manifest": "the manifest"}
    what = next((kinds[k] for n in torn for k in kinds if n.startswith(k)), "lines of CSV files" if torn else None)
    if what is None:
        started = (run_now.folder / "log").read_text()
        what = "steps, changes of the mesh" if "step " in started or "restart from" in started else START
    return what, "both ranks" if len(victims) == RANKS else "one rank"


def state(out):
    header, rows = read_csv(out / "diagnostics.csv")
    wall = header.index("wall_s")
    found = {f"lines of {n}": read_csv(out / n)[1] for n in ("tips.csv", "grains.csv")}
    found["lines of diagnostics.csv"] = [r[:wall] + r[wall + 1:] for r in rows]
    found["plt.hdf.series"] = json.loads((out / "plt.hdf.series").read_text())["files"]
    found["names of files"] = sorted(p.name for p in out.iterdir())
    return found, checkpoint_bits(out / f"chk_{LAST:07d}.h5")


def check_end(out, expected):
    found = state(out)
    other = [k for k in expected[0] if found[0][k] != expected[0][k]] + differences(found[1], expected[1])
    require(not other, f"after restarts these differ from the undisturbed run: {other}; {out}")


def leave_locks(*names):
    """Locked semaphores of Open MPI's, as a process leaves them that is killed while it opens a file of that name."""
    if Path("/dev/shm").is_dir():
        for name in names:
            Path(f"/dev/shm/sem.OMPIO_{name}").write_bytes(bytes(32))


def main():
    kills = int(sys.argv[3]) if len(sys.argv) > 3 else 5
    chance = random.Random(int(sys.argv[4]) if len(sys.argv) > 4 else 1)
    folder = scratch()
    (folder / "scene.toml").write_text(SCENE)
    start = time.monotonic()
    leave_locks("plt_0000000.hdf.part", "chk_0000005.h5.part")
    run("scene.toml", "output.dir=undisturbed", ranks=RANKS, cwd=folder)
    expected = state(folder / "undisturbed")
    manifest = json.loads((folder / "undisturbed/manifest.json").read_text())
    phases = {k: v["seconds"] for k, v in manifest["wall_by_phase"].items() if not k.startswith("ghost")}
    say(f"undisturbed: {LAST + 1} steps in {manifest['wall_s']:.1f} s, of that " +
        ", ".join(f"{k} {100 * v / manifest['wall_s']:.0f} %" for k, v in phases.items()))

    counts, victims, restarts, ends, fresh, hung = collections.Counter(), collections.Counter(), 0, 0, 0, 0
    while sum(counts.values()) < kills or (folder / "run").exists():
        restart = any((folder / "run").glob("chk_*.h5"))  # killed before the first checkpoint: from the beginning
        restarts, fresh = restarts + restart, fresh + (not restart)
        now = Run(folder, restart)
        done = None
        if sum(counts.values()) < kills and moment(now, chance, min(0.5 * manifest["wall_s"], 1.5)):
            done = kill(now, chance)
        text = now.wait(launcher_may_hang=done is not None and done[0] == START)
        hung += now.launcher_hung
        passed_over = re.findall(r"passed over.*", text)
        require(not passed_over, f"a damaged checkpoint under its final name: {passed_over}")
        if done:
            counts[done[0]] += 1
            victims[done[1]] += 1
            if sum(counts.values()) % 20 == 0:
                say(f"{sum(counts.values())} kills, {time.monotonic() - start:.0f} s")
            continue
        require(now.process.returncode == 0, f"a restart that was not killed ended with {now.process.returncode}: {text}")
        check_end(folder / "run", expected)
        ends += 1
        shutil.rmtree(folder / "run")
    say(f"{kills} kills ({', '.join(f'{n} of {k}' for k, n in victims.items())}) while writing or doing: "
        + ", ".join(f"{k} {n}" for k, n in counts.most_common()))
    say(f"{restarts} restarts, {fresh} starts anew; {ends} times at the end, each time equal to the undisturbed run; "
        f"mpirun hung {hung} times at the start; {time.monotonic() - start:.0f} s")
    require(restarts > 0 and ends > 0, "nothing was tried")


main()

#!/usr/bin/python3
"""A full disk, a folder that cannot be written and one that vanishes: exit code 4 with the cause, nothing half-written under
a final name, and the last checkpoint as it was. Needs a file system of its own, which only root can mount."""
import atexit
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import BUILD, CORNER_CRYSTAL, Result, check_result, command_line, environment, read_csv, require, run, say, scratch

SCENE = """
[run]
end_time_tau0 = 100
max_steps = 11
""" + CORNER_CRYSTAL + """[phase_field]
max_dt_tau0 = 0.01
[output]
dir = "disk/run"
diagnostics_every_tau0 = 0.05
checkpoint_every_steps = 10
"""
PAGE = os.sysconf("SC_PAGE_SIZE")
SIZE = 2 << 20


def mounted(folder):
    """A small file system; ends the test as skipped where there may be none."""
    disk = folder / "disk"
    disk.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "dendrift_test", disk], capture_output=True, text=True)
    if done.returncode != 0:
        say(f"skipped: no file system of its own for the test (needs root): {done.stderr.strip()}")
        sys.exit(77)
    atexit.register(subprocess.run, ["umount", "-l", disk])
    return disk


def fill(disk, leave):
    """Leaves this many bytes free."""
    free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
    with open(disk / "filler", "wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(free - leave, PAGE) // PAGE * PAGE)


def fill_to_the_last(disk):
    with open(disk / "filler", "ab", buffering=0) as file:
        try:
            while True:
                file.write(b"x" * PAGE)
        except OSError:
            pass


def sound(run_folder, checkpoint, content):
    """What must hold after every failure."""
    require(checkpoint.read_bytes() == content, "the last checkpoint is not as it was")
    names = sorted(p.name for p in run_folder.iterdir())
    require([n for n in names if n.startswith("chk_")] == [checkpoint.name], f"checkpoints: {names}")
    require(not [n for n in names if n.startswith("plt_") and n.endswith(".part")], f"half a plotfile: {names}")
    for csv in run_folder.glob("*.csv"):
        require(csv.read_text().endswith("\n"), f"half a line in {csv.name}")
        read_csv(csv)


def restarted(disk, *words, ranks=0, texts=(), code=4, folder=None):
    result = run("scene.toml", *words, "--restart", "disk/run", ranks=ranks, code=code, cwd=folder or disk.parent, timeout=60)
    for text in texts:
        require(text in result.err, f"'{text}' expected: {result}")
    if code == 4:
        require(result.err.count("dendrift: ") == 1, f"one message expected: {result}")
    return result


def while_running(disk, action, ranks, text):
    """The action once a run from the checkpoint has written lines: exit code 4 and the text in the message."""
    command = command_line("scene.toml", "run.max_steps=1000000", "output.checkpoint_every_steps=0", "--restart", "disk/run",
                           ranks=ranks)
    lines = disk / "run/diagnostics.csv"
    before = lines.read_text().count("\n")
    process = subprocess.Popen(command, cwd=disk.parent, env=environment(), text=True, stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE)
    try:
        while lines.read_text().count("\n") < before + 5:
            require(process.poll() is None, f"ended by itself: {process.stderr.read() if process.poll() is not None else ''}")
            time.sleep(0.02)
        action()
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    result = Result(command, process.returncode, "", err)
    check_result(result, 4)
    require(text in err and err.count("dendrift: ") == 1, f"'{text}' expected, once: {result}")
    return result


def without_reserving(folder, disk, checkpoint, content):
    """Where the file system cannot reserve space, a full disk shows in the middle of HDF5's work."""
    library = folder / "no_fallocate.so"
    code = "#include <errno.h>\n" + "".join(f"int {f}(int a, int b, long c, long d) {{ errno = EOPNOTSUPP; return -1; }}\n"
                                             for f in ("fallocate", "fallocate64"))
    compiler = shutil.which("cc") or shutil.which("gcc")
    sanitized = re.search(r"^DENDRIFT_SANITIZE:\w+=\w", (BUILD / "CMakeCache.txt").read_text(), re.M)
    if not compiler or sanitized:  # sanitizers want to be the first library themselves
        return say("no C compiler, or a sanitizer: nothing about file systems that cannot reserve space")
    subprocess.run([compiler, "-shared", "-fPIC", "-w", "-x", "c", "-o", library, "-"], input=code, text=True, check=True)
    os.environ["LD_PRELOAD"] = str(library)
    try:
        # From no room for HDF5's bookkeeping to nearly enough for the values
        for ranks, pages in ((0, 5), (0, 7), (2, 6), (2, 8), (2, 9)):
            fill(disk, pages * PAGE)
            restarted(disk, "run.max_steps=21", ranks=ranks, texts=("No space left" if pages < 7 else "could not",))
            (disk / "run/chk_0000020.h5").unlink(missing_ok=True)
            sound(disk / "run", checkpoint, content)
            (disk / "filler").unlink()
    finally:
        del os.environ["LD_PRELOAD"]
    say("full, on a file system that cannot reserve space")


def main():
    folder = scratch()
    disk = mounted(folder)
    (folder / "scene.toml").write_text(SCENE)
    run("scene.toml", cwd=folder)
    checkpoint = disk / "run/chk_0000010.h5"
    content = checkpoint.read_bytes()
    plotfile = max(p.stat().st_size for p in (disk / "run").glob("plt_*.hdf"))

    (disk / "run/plt_0000011.hdf").unlink()  # which a restart would remove, making room
    for ranks in (0, 2):
        fill(disk, len(content) // 2 + 6 * PAGE)  # the CSV files are written anew at the start
        restarted(disk, "run.max_steps=21", ranks=ranks, texts=("chk_0000020.h5", "No space left"))
        sound(disk / "run", checkpoint, content)
        (disk / "filler").unlink()
    say("full during a checkpoint")

    for ranks in (0, 2):
        fill(disk, plotfile // 2)
        restarted(disk, "run.max_steps=12", "output.checkpoint_every_steps=0", ranks=ranks,
                  texts=("plt_0000012.hdf", "No space left"))
        sound(disk / "run", checkpoint, content)
        require(not (disk / "run/plt_0000012.hdf").exists(), "half a plotfile has its final name")
        (disk / "filler").unlink()
    say("full during a plotfile")

    without_reserving(folder, disk, checkpoint, content)

    for ranks in (0, 2):
        result = while_running(disk, lambda: fill_to_the_last(disk), ranks, "No space left")
        require(".csv" in result.err, f"a CSV file expected: {result}")
        sound(disk / "run", checkpoint, content)
        (disk / "filler").unlink()
    say("full during a line of a CSV file")

    for ranks in (0, 2):
        result = while_running(disk, lambda: (disk / "run").rename(disk / "moved"), ranks, "No such file")
        require("disk/run/" in result.err, f"the file is not named: {result}")
        sound(disk / "moved", checkpoint.parent.parent / "moved" / checkpoint.name, content)
        (disk / "moved").rename(disk / "run")
    shutil.copytree(disk / "run", disk / "saved")
    while_running(disk, lambda: shutil.rmtree(disk / "run"), 0, "No such file")
    (disk / "saved").rename(disk / "run")
    say("a folder that vanishes")

    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    for ranks in (0, 2):
        result = restarted(disk, ranks=ranks, texts=("disk/run", "Read-only file system"))
        result = run("scene.toml", "output.dir=disk/new", ranks=ranks, code=4, cwd=folder)
        require("disk/new" in result.err and "Read-only file system" in result.err, f"a fresh run: {result}")
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    sound(disk / "run", checkpoint, content)
    say("a file system that cannot be written")

    restarted(disk, "run.max_steps=31", code=0)
    require((disk / "run/chk_0000030.h5").exists(), "the restart after all of this")
    steps = [int(r[0]) for r in read_csv(disk / "run/diagnostics.csv")[1]]
    require(steps == sorted(set(steps)) and steps[-1] == 31, f"steps {steps}")
    say("and the run goes on once there is room")


main()

#!/usr/bin/python3
"""What a restart may change and what not, checkpoints by the wall clock, and stopping by SIGINT."""
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import CORNER_CRYSTAL, column, command_line, environment, require, run, say, scratch, snapshot

SCENE = """
[run]
end_time_tau0 = 100
max_steps = 21
""" + CORNER_CRYSTAL + """[output]
dir = "run"
diagnostics_every_tau0 = 1
checkpoint_every_steps = 10
"""
# Key, value in the checkpoint and in the restart
PHYSICS = [("alloy.supersaturation", "0.2", "0.3"), ("phase_field.max_dt_tau0", "0.24", "0.2"),
           ("seed[0].angle_deg", "0.0", "30.0"), ("seed[0].radius_W0", "8.0", "8.5"), ("mesh.levels", "3", "2"),
           ("mesh.max_regrid_steps", "50", "10"), ("flow", "absent", "present")]
BLOCKS = [("mesh.block_cells", "8", "16"), ("mesh.root_blocks", "[2, 1]", "[4, 2]"),
          ("mesh.size_W0", "[64.0, 32.0]", "[128.0, 64.0]")]
FREE = [("run.title", '""', '"longer"'), ("run.end_time_tau0", "100.0", "200.0"), ("run.max_steps", "21", "25"),
        ("run.wall_clock_limit_s", "0.0", "1000.0"), ("output.checkpoint_every_steps", "10", "3"),
        ("output.plot_every_tau0", "unset", "2.0"), ("parallel.partitioner", '"curve"', '"graph"')]


def word(key, value):
    return "flow.coupling=projection" if key == "flow" else f"{key}={value}"


def check_changes(folder):
    (folder / "scene.toml").write_text(SCENE)
    run("scene.toml", cwd=folder)
    before = snapshot(folder)
    for key, old, new in PHYSICS + BLOCKS:
        for ranks in (0, 2) if key == "mesh.levels" else (0,):
            result = run("scene.toml", word(key, new), "--restart", "run", ranks=ranks, code=2, cwd=folder)
            for text in (f"{key}\n", f"expected: {old}, as in run/chk_0000020.h5", f"found:    {new}", "--allow-changes"):
                require(text in result.err, f"'{text}' expected: {result}")
            require(snapshot(folder) == before, f"something was written: {result}")
    result = run("scene.toml", *(word(k, n) for k, _, n in PHYSICS), "--restart", "run", code=2, cwd=folder)
    require(f"{len(PHYSICS)} problems" in result.err, f"all changes at once: {result}")
    for key, old, new in BLOCKS:
        result = run("scene.toml", word(key, new), "--restart", "run", "--allow-changes", code=2, cwd=folder)
        require(key in result.err and "chk_0000020.h5" in result.err, f"{key}: {result}")
    result = run("scene.toml", "flow.coupling=projection", "--restart", "run", "--allow-changes", code=4, cwd=folder)
    require("does not hold" in result.err and "velocity_x" in result.err, f"a flow that the checkpoint does not hold: {result}")
    require(snapshot(folder) == before, "something was written")
    say(f"{len(PHYSICS) + len(BLOCKS)} changes of physics and mesh: refused with file, key and both values")

    allowed = [c for c in PHYSICS if c[0] not in ("mesh.levels", "flow")]
    result = run("scene.toml", *(word(k, n) for k, _, n in allowed), "output.dir=other", "--allow-changes", "--restart", "run",
                 cwd=folder)
    for key, old, new in allowed:
        require(f"restart: CHANGES {key}: {old} -> {new}\n" in result.out, f"{key} is not in the log: {result}")
    result = run("scene.toml", *(word(k, n) for k, _, n in FREE), "output.dir=more", "--restart", "run", ranks=2, threads=2,
                 cwd=folder)
    for key, old, new in FREE:
        require(f"restart: {key}: {old} -> {new}\n" in result.out, f"{key} is not in the log: {result}")
    require("restart: ranks 2, threads 2" in result.out and "before:  ranks 1, threads 1" in result.out, f"ranks: {result}")
    require((folder / "more/chk_0000024.h5").exists(), "another interval of checkpoints")
    result = run("scene.toml", "--restart", "run", cwd=folder)
    require(result.out.count("restart") == 1, f"nothing changed: {result}")
    say(f"--allow-changes: {len(allowed)} changes, in the log; {len(FREE)} need no flag")


def check_seeds_file(folder):
    scene = SCENE.replace("[[seed]]\nposition_W0 = [0, 0]\nradius_W0 = 8", '[seeds]\nfile = "seeds.csv"')
    (folder / "scene.toml").write_text(scene)
    (folder / "seeds.csv").write_text("x_W0,y_W0,radius_W0\n0,0,8\n")
    run("scene.toml", cwd=folder)
    (folder / "seeds.csv").write_text("x_W0,y_W0,radius_W0\n1,0,8\n")
    result = run("scene.toml", "--restart", "run", code=2, cwd=folder)
    require("seeds.file\n" in result.err and result.err.count("checksum") == 2, f"another file of seeds: {result}")
    say("another content of the file of seeds: refused")


def checkpoints(folder):
    return sorted(p.name for p in (folder / "run").glob("chk_*"))


def check_given_up(folder):
    """After a restart from an older checkpoint, the later ones are those of another course."""
    (folder / "scene.toml").write_text(SCENE)
    run("scene.toml", cwd=folder)
    shutil.copytree(folder / "run", folder / "copy")
    # Stopped before it writes anything new, a restart has already dropped what was later.
    run("scene.toml", "run.wall_clock_limit_s=1e-6", "--restart", "run/chk_0000010.h5", code=75, cwd=folder)
    listed = [e["name"] for e in json.loads((folder / "run/plt.hdf.series").read_text())["files"]]
    plotfiles = sorted(p.name for p in (folder / "run").glob("plt_*"))
    require(listed == plotfiles == ["plt_0000000.hdf"], f"plotfiles later than the checkpoint: {listed}, {plotfiles}")
    require(max(column(folder / "run/diagnostics.csv", "step", int)) <= 10, "lines later than the checkpoint")
    shutil.rmtree(folder / "run")
    (folder / "copy").rename(folder / "run")
    run("scene.toml", "run.max_steps=15", "--restart", "run/chk_0000010.h5", cwd=folder)
    require(checkpoints(folder) == ["chk_0000010.h5", "chk_0000020.h5.old"], f"set aside: {checkpoints(folder)}")
    result = run("scene.toml", "--restart", "run", cwd=folder)
    require("restart from run/chk_0000010.h5" in result.out, f"the later checkpoint of another course: {result}")
    require(checkpoints(folder) == ["chk_0000010.h5", "chk_0000020.h5"], f"at the end: {checkpoints(folder)}")
    say("a restart from an older checkpoint gives up the later ones")


def check_wall_clock(folder):
    (folder / "scene.toml").write_text(SCENE.replace("checkpoint_every_steps = 10", "checkpoint_every_wall_s = 0.1"))
    for ranks in (0, 2):
        run("scene.toml", "run.max_steps=1000000", "run.wall_clock_limit_s=1", "phase_field.max_dt_tau0=0.001",
            "output.keep_checkpoints=100", code=75, ranks=ranks, cwd=folder)
        count = len(list((folder / "run").glob("chk_*.h5")))
        require(3 <= count <= 11, f"{count} checkpoints in a second, one every tenth of it")
    say("output.checkpoint_every_wall_s")


def pending(process, number):
    status = Path(f"/proc/{process.pid}/status").read_text()
    return any(int(line.split()[1], 16) >> (number - 1) & 1 for line in status.splitlines() if line[:6] in ("SigPnd", "ShdPnd"))


def interrupted(folder, times):
    """The exit code after SIGINT so many times, each as soon as the last has arrived."""
    shutil.rmtree(folder / "run", ignore_errors=True)
    process = subprocess.Popen(command_line("scene.toml", "run.max_steps=1000000", "phase_field.max_dt_tau0=0.001"), cwd=folder,
                               env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while not list((folder / "run").glob("chk_*.h5")):
            require(process.poll() is None, "ended by itself")
            time.sleep(0.02)
        for _ in range(times):
            process.send_signal(signal.SIGINT)
            while process.poll() is None and pending(process, signal.SIGINT):
                pass
        return process.wait(timeout=60)
    finally:
        process.kill()
        process.wait()


def check_interrupt(folder):
    (folder / "scene.toml").write_text(SCENE)
    require(interrupted(folder, 1) == 75, "SIGINT: exit code 75 expected")
    run("scene.toml", "run.max_steps=1000000", "--restart", "run", "--check", "phase_field.max_dt_tau0=0.001", cwd=folder)
    codes = [interrupted(folder, 2) for _ in range(3)]  # the first may have been fast enough
    require(-signal.SIGINT in codes and set(codes) <= {-signal.SIGINT, 75}, f"SIGINT twice: exit codes {codes}")
    run("scene.toml", "run.max_steps=1000000", "--restart", "run", "--check", "phase_field.max_dt_tau0=0.001", cwd=folder)
    say("SIGINT: a checkpoint and exit code 75; a second one ends the run at once")


check_changes(scratch())
check_seeds_file(scratch())
check_given_up(scratch())
check_wall_clock(scratch())
check_interrupt(scratch())

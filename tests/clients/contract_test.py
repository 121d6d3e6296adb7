#!/usr/bin/python3
"""What users and scripts rely on: the command line, the files under output.dir with their columns and fields, the exit
codes, stopping and restarting."""
import json
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import (Failure, Result, check_result, column, command_line, environment, fail, read_csv, require,
                     reseal, run, say, scratch, snapshot)

# Columns that must stand at the beginning, in this order; more may follow.
DIAGNOSTICS = ["step", "time_s", "time_tau0", "dt_tau0", "blocks", "cells", "levels", "solid_fraction",
               "solute_mean_wt", "solute_drift_rel", "max_speed_um_s", "div_max_rel", "flow_iterations", "wall_s"]
TIPS = {2: ["time_s", "grain", "arm", "euler_deg", "x_um", "y_um", "speed_um_s", "radius_um"],
        3: ["time_s", "grain", "arm", "euler_deg", "x_um", "y_um", "z_um", "speed_um_s", "radius_um"]}
GRAINS = {2: ["time_s", "grain", "x_um", "y_um", "vx_um_s", "vy_um_s", "omega_rad_s", "angle_rad", "area_um2",
              "nonrigidity"],
          3: ["time_s", "grain", "x_um", "y_um", "z_um", "vx_um_s", "vy_um_s", "vz_um_s", "omega_x_rad_s",
              "omega_y_rad_s", "omega_z_rad_s", "q0", "q1", "q2", "q3", "volume_um3", "nonrigidity"]}
FIELDS = {2: ["phi", "U", "c", "alpha", "velocity_x", "velocity_y", "pressure", "level", "rank", "grain"],
          3: ["phi", "U", "c", "alpha", "velocity_x", "velocity_y", "velocity_z", "pressure", "level", "rank", "grain"]}
MANIFEST = ["version", "git_hash", "compiler", "flags", "ranks", "threads", "machine", "input", "start", "end",
            "status", "exit_code", "message", "wall_s", "wall_by_phase"]
KEYS = ["run.end_time_s", "run.max_steps", "run.wall_clock_limit_s", "output.dir", "output.plot_every_s",
        "output.checkpoint_every_s", "mesh.dim"]  # those that scripts override

# Al-4wt%Cu, the defaults of [alloy]
K, OMEGA, C0_WT, SLOPE, GIBBS_THOMSON, DIFFUSIVITY, W0_OVER_D0 = 0.14, 0.2, 4.0, 2.65, 0.236, 2400.0, 10
C_L = C0_WT / (1 - (1 - K) * OMEGA)
D0_UM = GIBBS_THOMSON / (SLOPE * C_L * (1 - K))
W0_UM = W0_OVER_D0 * D0_UM
LAMBDA = 0.8839 * W0_OVER_D0
TAU0_S = 0.6267 * LAMBDA * W0_UM**2 / DIFFUSIVITY
VISCOSITY = 5e5  # um2/s

# A quarter of a crystal, and an eighth of one; 5 tau0, in seconds because scripts override seconds.
SCENES = {2: """
[run]
title = 'a "quoted" title'
end_time_s = {end}
[mesh]
dim = 2
size_W0 = [128, 64]
root_blocks = [2, 1]
levels = 4
block_cells = 8
xlo = "symmetry"
ylo = "symmetry"
[[seed]]
position_W0 = [0, 0]
radius_W0 = 8
[output]
diagnostics_every_s = {line}
""", 3: """
[run]
end_time_s = {end}
[mesh]
dim = 3
size_W0 = [32, 32, 32]
root_blocks = [1, 1, 1]
levels = 3
block_cells = 8
xlo = "symmetry"
ylo = "symmetry"
zlo = "symmetry"
[[seed]]
position_W0 = [0, 0, 0]
radius_W0 = 8
[output]
diagnostics_every_s = {line}
"""}
# The same in short steps, a minute's worth of them, to be interrupted at once.
ENDLESS = ["run.end_time_s=1", "run.max_steps=200000", "phase_field.max_dt_tau0=0.01",
           f"output.diagnostics_every_s={0.1 * TAU0_S}"]


def write_scene(folder, dim):
    path = folder / f"scene_{dim}d.toml"
    path.write_text(SCENES[dim].format(end=5 * TAU0_S, line=TAU0_S))
    return path


def close(a, b, tolerance=1e-12):
    return math.isclose(a, b, rel_tol=tolerance, abs_tol=0)


def names(folder):
    return {p.name for p in Path(folder).iterdir()}


def key_names(text):
    """table.key of every line of --keys; each must have a type and a meaning."""
    found, table = [], ""
    for line in text.splitlines()[1:]:
        if heading := re.match(r"\[+(\w+)\]+", line):
            table = heading[1]
        elif line.strip():
            words = line.split()
            require(len(words) >= 4, f"--keys: no type, default or meaning in '{line}'")
            found.append(f"{table}.{words[0]}")
    require(len(found) == len(set(found)) > 40, f"--keys lists {len(found)} keys")
    return found


def check_command_line(folder):
    version = run("--version", cwd=folder).out
    require(re.match(r"dendrift \d+\.\d+\.\d+ .*commit \S+\n.*-O\d", version, re.S), f"--version: {version}")
    for option in ("-h", "--help"):
        text = run(option, cwd=folder).out
        for word in ("--check", "--keys", "--restart", "--version", "--help"):
            require(word in text, f"{option} does not mention {word}: {text}")
    keys = {2: key_names(run("--keys", cwd=folder).out), 3: key_names(run("--keys", "mesh.dim=3", cwd=folder).out)}
    require(set(KEYS) <= set(keys[2]), f"--keys lacks {set(KEYS) - set(keys[2])}")
    require(set(keys[2]) | {"mesh.zlo", "mesh.zhi"} == set(keys[3]),
            "--keys in 3D: the keys of 2D, zlo and zhi expected")
    require(not names(folder), f"{names(folder)} appeared")
    say("--version, --help, --keys")
    return keys


def check_check(folder):
    for dim in (2, 3):
        scene = write_scene(folder, dim)
        before = snapshot(folder)
        text = run(scene, "--check", "output.dir=some/where", cwd=folder).out
        require(snapshot(folder) == before, "--check wrote something")
        require("\noutput dir: some/where\n" in text, f"--check does not name the output folder: {text}")
        numbers = {m[1]: float(m[2]) for m in re.finditer(r"^(\w+) +(-?[\d.]+(?:e[-+]?\d+)?)", text, re.M)}
        expected = {"c_l": C_L, "d0": D0_UM, "W0": W0_UM, "tau0": TAU0_S, "lambda": LAMBDA, "D": 0.6267 * LAMBDA,
                    "nu": VISCOSITY * TAU0_S / W0_UM**2, "end": 5, "dx": 1}
        for name, value in expected.items():
            require(close(numbers.get(name, 0), value, 1e-5), f"--check: {name} = {value} expected: {text}")
        for name in ("dt", "cells", "memory", "cost"):
            require(numbers.get(name, 0) > 0, f"--check: no {name}: {text}")
        # It is what the run then does.
        run(scene, "run.max_steps=0", "output.dir=out", cwd=folder)
        require(column(folder / "out/diagnostics.csv", "cells", int) == [numbers["cells"]],
                f"--check announced {numbers['cells']} cells")
        shutil.rmtree(folder / "out")
    text = run(write_scene(folder, 2), "--check", "mesh.dim=3", "mesh.size_W0=[64,64,64]", "mesh.root_blocks=[1,1,1]",
               "seed[0].position_W0=[0,0,0]", cwd=folder).out
    require("\nbox     64 64 64 W0" in text, f"mesh.dim=3 on the command line: {text}")
    # A mesh beyond the memory of the machine: four arrays or more of 36^3 numbers in each of 1000000 blocks, 1.5 TB
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for words in (["--check"], []) if memory < 1e12 else ():
        result = run(write_scene(folder, 3), *words, "mesh.size_W0=[3200,3200,3200]", "mesh.root_blocks=[100,100,100]",
                     "mesh.levels=1", "mesh.block_cells=32", code=2, cwd=folder)
        for word in ("mesh.root_blocks", "expected: a mesh that fits into the memory", "found:    1000000 blocks"):
            require(word in result.err, f"'{word}' expected: {result}")
    say("--check: derived numbers, output dir, nothing written")


def check_files(folder, dim, keys):
    scene, out = write_scene(folder, dim), folder / "out"
    plot_every, check_every = 2 * TAU0_S, 1 * TAU0_S
    out.mkdir()
    (out / "notes.txt").write_text("not the program's\n")
    run(scene, f"output.plot_every_s={plot_every}", f"output.checkpoint_every_s={check_every}", "output.dir=out",
        ranks=2, threads=2, cwd=folder)

    # 1. Names: plotfiles at 0, 2, 4 and at the end, 5; the last two of the checkpoints at 1, 2, 3, 4
    times = [round(t, 9) for t in column(out / "diagnostics.csv", "time_tau0")]
    steps = dict(zip(times, column(out / "diagnostics.csv", "step", int)))
    require(list(steps) == [0, 1, 2, 3, 4, 5], f"{dim}D: lines of diagnostics.csv at {list(steps)} tau0")
    plots = {f"plt_{steps[t]:07d}.hdf": t for t in (0, 2, 4, 5)}
    checkpoints = {f"chk_{steps[t]:07d}.h5": t for t in (3, 4)}
    fixed = {"diagnostics.csv", "tips.csv", "manifest.json", "plt.hdf.series", "notes.txt"}
    require(names(out) - {"grains.csv"} == fixed | plots.keys() | checkpoints.keys(),
            f"{dim}D: files {sorted(names(out))}")

    # 2. Columns
    n = 8**dim
    header, rows = read_csv(out / "diagnostics.csv")
    require(header[:len(DIAGNOSTICS)] == DIAGNOSTICS, f"{dim}D: columns of diagnostics.csv: {header}")
    table = {name: [float(r[i]) for r in rows] for i, name in enumerate(header)}
    for i in range(len(rows)):
        line = {name: values[i] for name, values in table.items()}
        require(all(map(math.isfinite, line.values())), f"{dim}D: {line}")
        require(close(line["time_s"], line["time_tau0"] * TAU0_S), f"{dim}D: seconds and tau0 differ: {line}")
        require(line["cells"] == n * line["blocks"] and 1 <= line["levels"] <= 4, f"{dim}D: {line}")
        require(abs(line["solute_drift_rel"]) < 1e-13, f"{dim}D: solute is lost: {line}")
    for name in ("step", "time_s", "solid_fraction", "wall_s"):
        require(all(a < b for a, b in zip(table[name], table[name][1:])),
                f"{dim}D: {name} does not rise: {table[name]}")
    # (1 + tanh((R-r)/sqrt 2))/2 over a quarter of a disc or an eighth of a ball of R = 8: a smeared edge of variance
    # pi^2/6 adds to them; the sum over cells of size 1 comes within 1e-4 of the integral.
    solid = (math.pi / 4 * (64 + math.pi**2 / 6) / (128 * 64) if dim == 2 else
             math.pi / 2 * (512 / 3 + 8 * math.pi**2 / 6) / 32**3)
    require(close(table["solid_fraction"][0], solid, 1e-3), f"{dim}D: solid fraction {table['solid_fraction'][0]}")
    header, rows = read_csv(out / "tips.csv")
    require(header[:len(TIPS[dim])] == TIPS[dim], f"{dim}D: columns of tips.csv: {header}")
    require(len(rows) == dim * len(steps), f"{dim}D: {len(rows)} tips in {len(steps)} lines of {dim} arms in the box")
    first = dict(zip(header, map(float, rows[0])))
    require(first["grain"] == 0 and close(first["x_um"], 8 * W0_UM, 1e-3), f"{dim}D: first tip {first}")
    if "grains.csv" in names(out):
        header = read_csv(out / "grains.csv")[0]
        require(header[:len(GRAINS[dim])] == GRAINS[dim], f"{dim}D: columns of grains.csv: {header}")

    # 3. Plotfiles and their list
    series = json.loads((out / "plt.hdf.series").read_text())
    require(series["file-series-version"] == "1.0", f"{dim}D: {series}")
    require([e["name"] for e in series["files"]] == list(plots), f"{dim}D: {series}")
    for entry in series["files"]:
        require(math.isclose(entry["time"], plots[entry["name"]] * TAU0_S, rel_tol=1e-9), f"{dim}D: {entry}")
        with h5py.File(out / entry["name"]) as file:
            fields = [file.attrs[f"component_{i}"] for i in range(file.attrs["num_components"])]
            fields = [f.decode() if isinstance(f, bytes) else str(f) for f in fields]
            require(fields == FIELDS[dim], f"{dim}D: fields {fields}")
            require(file.attrs["time"] == entry["time"], f"{dim}D: {entry['name']} is of {file.attrs['time']} s")
            require(file.attrs["iteration"] == int(entry["name"][4:11]), f"{dim}D: step of {entry['name']}")
            require(file["Chombo_global"].attrs["SpaceDim"] == dim and "VTKHDF" in file, f"{dim}D: not a dual plotfile")
    for name, t in checkpoints.items():
        with h5py.File(out / name) as file:
            require(close(file.attrs["time_tau0"], t) and file.attrs["dim"] == dim, f"{dim}D: time or dim of {name}")

    # 4. The manifest, and the run that its input gives
    manifest = json.loads((out / "manifest.json").read_text())
    require(set(MANIFEST) <= manifest.keys(), f"{dim}D: manifest.json lacks {set(MANIFEST) - manifest.keys()}")
    require((manifest["status"], manifest["ranks"], manifest["threads"]) == ("done", 2, 2), f"{dim}D: {manifest}")
    require((manifest["exit_code"], manifest["message"]) == (0, ""), f"{dim}D: {manifest}")
    require(manifest["steps"] == steps[5] and close(manifest["time_s"], 5 * TAU0_S), f"{dim}D: {manifest}")
    stamps = [time.strptime(manifest[k], "%Y-%m-%dT%H:%M:%SZ") for k in ("start", "end")]
    require(stamps[0] <= stamps[1], f"{dim}D: start and end {manifest['start']}, {manifest['end']}")
    phases = manifest["wall_by_phase"]
    require({"regrid", "plotfile", "checkpoint"} <= phases.keys()
            and all(0 <= p["seconds"] <= manifest["wall_s"] * 1.01 for p in phases.values()), f"{dim}D: {phases}")
    resolved = tomllib.loads(manifest["input"])
    require(resolved["output"]["plot_every_s"] == plot_every and resolved["run"].get("title", "") in
            ("", 'a "quoted" title'), f"{dim}D: the resolved input is not this run's")
    given = {f"{table}.{key}" for table, content in resolved.items()
             for element in (content if isinstance(content, list) else [content]) for key in element}
    require(given <= set(keys[dim]), f"{dim}D: --keys does not list {given - set(keys[dim])}")
    (folder / "resolved.toml").write_text(manifest["input"])
    run("resolved.toml", "output.dir=again", cwd=folder)
    wall = DIAGNOSTICS.index("wall_s")
    same = [[r[:wall] for r in read_csv(folder / d / "diagnostics.csv")[1]] for d in ("out", "again")]
    require(same[0] == same[1], f"{dim}D: the resolved input gives another run")

    # 5. A new run in the same folder removes what would be mistaken for its own, and nothing else.
    run(scene, "run.max_steps=0", "output.dir=out", cwd=folder)
    require(names(out) - {"grains.csv"} == fixed | {"plt_0000000.hdf"}, f"{dim}D: left over: {sorted(names(out))}")
    require((out / "notes.txt").read_text() == "not the program's\n", f"{dim}D: notes.txt was touched")
    say(f"{dim}D: files, columns, plotfiles and their list, checkpoints, manifest, resolved input")


def stop_by(stop_signal, scene, folder, ranks=0):
    """Sends a signal to a run that has written a few lines."""
    command = command_line(scene, *ENDLESS, "output.dir=out", ranks=ranks)
    process = subprocess.Popen(command, cwd=folder, env=environment(), text=True, stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 60
        lines = folder / "out/diagnostics.csv"
        while not lines.exists() or lines.read_text().count("\n") < 4:
            if process.poll() is not None:
                fail(f"ended by itself: {process.communicate()}")
            require(time.monotonic() < deadline, "no lines in diagnostics.csv after 60 s")
            time.sleep(0.02)
        process.send_signal(stop_signal)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    return Result(command, process.returncode, out, err)


def check_stopped(folder, scene, name):
    """A stopped run has a checkpoint of its last step, and goes on from it."""
    out = folder / "out"
    manifest = json.loads((out / "manifest.json").read_text())
    require((manifest["status"], manifest["exit_code"]) == ("stopped", 75), f"{name}: status {manifest['status']}")
    last = manifest["steps"]
    require(f"chk_{last:07d}.h5" in names(out), f"{name}: stopped at step {last}, files {sorted(names(out))}")
    before = column(out / "diagnostics.csv", "step", int)
    target = last + 25
    run(scene, *ENDLESS, f"run.max_steps={target}", "output.dir=out", "--restart", "out", cwd=folder)
    after = column(out / "diagnostics.csv", "step", int)
    require(after[:len(before)] == before and after[-1] == target and after == sorted(set(after)),
            f"{name}: steps {before}, after the restart {after}")
    require(json.loads((out / "manifest.json").read_text())["status"] == "done", f"{name}: status after the restart")
    require({"plt_0000000.hdf", f"plt_{target:07d}.hdf"} <= names(out), f"{name}: plotfiles {sorted(names(out))}")
    listed = [e["name"] for e in json.loads((out / "plt.hdf.series").read_text())["files"]]
    require(listed == ["plt_0000000.hdf", f"plt_{target:07d}.hdf"], f"{name}: listed {listed}")
    shutil.rmtree(out)


def check_stopping(folder):
    for dim in (2, 3):
        scene = write_scene(folder, dim)
        for stop_signal in (signal.SIGTERM, signal.SIGUSR1):
            name = f"{dim}D, {stop_signal.name}"
            check_result(stop_by(stop_signal, scene, folder), 75)
            check_stopped(folder, scene, name)
    scene = write_scene(folder, 2)
    check_result(stop_by(signal.SIGUSR1, scene, folder, ranks=2), 75)  # which mpirun passes on
    check_stopped(folder, scene, "SIGUSR1 on 2 ranks")
    say("SIGTERM, SIGUSR1: exit code 75, a checkpoint, --restart goes on")

    for ranks in (0, 2):
        start = time.monotonic()
        run(scene, *ENDLESS, "run.wall_clock_limit_s=0.5", "output.dir=out", ranks=ranks, code=75, cwd=folder)
        require(0.5 < time.monotonic() - start < 30, f"a limit of 0.5 s took {time.monotonic() - start} s")
        check_stopped(folder, scene, f"wall clock limit, ranks {ranks}")
    say("run.wall_clock_limit_s: the same")

    # Killed: what was written stays, in whole lines.
    result = stop_by(signal.SIGKILL, scene, folder)
    require(result.code == -signal.SIGKILL, f"{result}")
    require((folder / "out/diagnostics.csv").read_text().endswith("\n"), "a torn line in diagnostics.csv")
    require(len(read_csv(folder / "out/diagnostics.csv")[1]) >= 3, "lines of a killed run are lost")
    manifest = json.loads((folder / "out/manifest.json").read_text())
    require((manifest["status"], manifest["exit_code"]) == ("running", None), "status of a killed run")
    shutil.rmtree(folder / "out")
    say("SIGKILL: whole lines in diagnostics.csv")


def check_numerical_failure(folder):
    scene = write_scene(folder, 2)
    run(scene, "output.checkpoint_every_steps=10", "output.dir=out", cwd=folder)
    checkpoint = max((folder / "out").glob("chk_*.h5"))
    with h5py.File(checkpoint, "r+") as file:
        file["fields/c"][7] = math.nan
    reseal(checkpoint)
    for ranks in (0, 2):
        result = run(scene, "output.dir=out", "--restart", checkpoint, ranks=ranks, code=3, cwd=folder)
        require(len(re.findall(r"not finite at step \d+", result.err)) == 1, f"no cause, or more than one: {result}")
        manifest = json.loads((folder / "out/manifest.json").read_text())
        require((manifest["status"], manifest["exit_code"]) == ("failed", 3) and "not finite" in manifest["message"],
                f"status {manifest['status']}, {manifest['exit_code']}, {manifest['message']}")
        saved = [n for n in names(folder / "out") - {checkpoint.name} if n.endswith(f"_{manifest['steps']:07d}.h5")]
        require(saved, f"the state of step {manifest['steps']} was not saved: {sorted(names(folder / 'out'))}")
        (folder / "out" / saved[0]).unlink()
    for coupling in ("coupled", "projection"):
        shutil.rmtree(folder / "out")
        scene.write_text(SCENES[2].format(end=5 * TAU0_S, line=TAU0_S) + "[flow]\nmax_iterations = 1\n")
        result = run(scene, "output.dir=out", f"flow.coupling={coupling}", code=3, cwd=folder)
        require(result.err.count("the flow did not converge") == 1, f"no cause, or more than one: {result}")
        manifest = json.loads((folder / "out/manifest.json").read_text())
        require((manifest["status"], manifest["exit_code"]) == ("failed", 3) and "did not converge" in manifest["message"],
                f"status {manifest['status']}, {manifest['exit_code']}, {manifest['message']}")
        require(f"failed_{manifest['steps']:07d}.h5" in names(folder / "out"), f"not saved: {names(folder / 'out')}")
    say("numerical failure: exit code 3, cause, state")


def check_output_failures(folder):
    scene = write_scene(folder, 2)
    (folder / "file").write_text("a file, not a folder\n")
    before = snapshot(folder)
    for where in ("file", "file/sub", "file/sub/sub"):
        for ranks in (0, 2):
            result = run(scene, f"output.dir={where}", ranks=ranks, code=4, cwd=folder)
            require(result.err.count(f"dendrift: {where}: could not ") == 1, f"no cause, or more than one: {result}")
            require(snapshot(folder) == before, f"output.dir={where}: something was written")
    # A full disk; a limit to the size of files looks the same to the program.
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limit[1]))
        result = run(scene, "output.dir=out", code=4, cwd=folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    require("plt_0000000.hdf" in result.err, f"the file is not named: {result}")
    require(not {n for n in names(folder / "out") if n.startswith("plt")}, "half a plotfile was left")
    manifest = json.loads((folder / "out/manifest.json").read_text())
    require((manifest["status"], manifest["exit_code"]) == ("failed", 4) and "plt_0000000.hdf" in manifest["message"],
            f"status {manifest['status']}, {manifest['exit_code']}, {manifest['message']}")
    shutil.rmtree(folder / "out")
    # A folder in the place of a file
    (folder / "out/diagnostics.csv").mkdir(parents=True)
    for ranks in (0, 2):
        run(scene, "output.dir=out", ranks=ranks, code=4, cwd=folder)
        manifest = json.loads((folder / "out/manifest.json").read_text())
        require(manifest["status"] == "failed" and "diagnostics.csv" in manifest["message"], f"manifest {manifest}")
    shutil.rmtree(folder / "out")
    say("output that cannot be written: exit code 4 with the cause")


def check_bad_restarts(folder):
    scenes = {dim: write_scene(folder, dim) for dim in (2, 3)}
    for dim, scene in scenes.items():
        run(scene, "output.checkpoint_every_steps=5", f"output.dir=run{dim}", cwd=folder)
    good = max((folder / "run2").glob("chk_*.h5"))
    (folder / "garbage.h5").write_text("this is not HDF5\n")
    (folder / "empty.h5").write_text("")
    (folder / "cut.h5").write_bytes(good.read_bytes()[:good.stat().st_size // 2])
    (folder / "nothing_in_it").mkdir()

    def changed(name, change):
        shutil.copy(good, folder / name)
        with h5py.File(folder / name, "r+") as file:
            change(file)
        reseal(folder / name)

    changed("no_fields.h5", lambda f: f.pop("fields"))
    changed("no_leaves.h5", lambda f: f.pop("leaves"))
    changed("later_format.h5", lambda f: f.attrs.modify("format", np.int32(99)))
    changed("no_next_regrid.h5", lambda f: f["numbers"].attrs.pop("next_regrid"))
    changed("bad_leaf.h5", lambda f: f["leaves"].__setitem__(0, 9))
    # What each message must say beside the name of the file
    cases = {"missing.h5": "no such file", "missing/folder": "no such file", "run2/plt_0000000.hdf": "not a checkpoint",
             "run2/manifest.json": "open", "garbage.h5": "open", "empty.h5": "open", "cut.h5": "truncated",
             "nothing_in_it": "no checkpoint", "no_fields.h5": "fields",
             "no_leaves.h5": "not a checkpoint", "later_format.h5": "99", "no_next_regrid.h5": "", "bad_leaf.h5": ""}
    (folder / "out").mkdir()
    (folder / "out/plt_0000000.hdf").write_text("an earlier run's\n")
    before = snapshot(folder)
    failures = []

    def refused(name, words, text, ranks=0, code=4):
        nonlocal before
        try:
            result = run(*words, "output.dir=out", ranks=ranks, code=code, cwd=folder, timeout=60)
            require(name in result.err and text in result.err, f"'{name}' and '{text}' expected: {result}")
            require(result.err.count("dendrift: ") == 1, f"said more than once: {result}")
            require(snapshot(folder) == before, f"something was written: {result}")
        except Failure as failure:
            failures.append(f"{name}, {ranks} ranks: {failure}")
            say(failures[-1])
            before = snapshot(folder)

    for name, text in cases.items():
        refused(name, [scenes[2], "--restart", name], text)
    refused("", [scenes[2], "--restart", ""], "", code=(2, 4))  # a script's empty variable is no fresh start
    for name in ("missing.h5", "run2/plt_0000000.hdf", "garbage.h5"):
        refused(name, [scenes[2], "--restart", name], cases[name], ranks=2)
    for ranks in (0, 2):
        refused("run3", [scenes[2], "--restart", "run3"], "mesh.dim", ranks=ranks, code=2)
    # A checkpoint of another box, mesh or number of crystals: the input contradicts the checkpoint
    for words in (["mesh.size_W0=[256, 128]"], ["mesh.root_blocks=[4, 2]"], ["mesh.levels=3"], ["mesh.block_cells=16"],
                  ["mesh.xlo=periodic", "mesh.xhi=periodic"], ["seed[1].position_W0=[90, 40]", "seed[1].radius_W0=5"]):
        refused(good.name, [scenes[2], *words, "--restart", good], "", code=(2, 4))
    # An end before the time of the checkpoint, and the same in steps
    with h5py.File(good) as file:
        time_tau0, step = file.attrs["time_tau0"], int(file.attrs["step"])
    for word, key in ((f"run.end_time_s={0.99 * time_tau0 * TAU0_S}", "run.end_time_s"),
                      (f"run.end_time_tau0={0.99 * time_tau0}", "run.end_time_tau0"),
                      (f"run.max_steps={step - 1}", "run.max_steps")):
        for ranks in (0, 2):
            refused(key, [scenes[2], word, "--restart", good], "at least", ranks=ranks, code=2)
        refused(key, [scenes[2], word, "--restart", good, "--check"], "at least", code=2)
    require(not failures, f"{len(failures)} of the restarts above")
    say(f"--restart: {len(cases)} bad files, 6 checkpoints of other scenes, 3 ends before "
        "the checkpoint: refused with the cause, nothing touched")


def check_kept_checkpoints(folder):
    """output.keep_checkpoints counts those from before a restart; those after its state go first."""
    scene, out = write_scene(folder, 2), folder / "out"
    every = ["output.checkpoint_every_steps=5", "output.dir=out"]

    def kept():
        return sorted(int(n[4:11]) for n in names(out) if n.startswith("chk_"))

    run(scene, *every, "run.max_steps=16", "output.keep_checkpoints=3", cwd=folder)
    require(kept() == [5, 10, 15], f"checkpoints {kept()}")
    shutil.copytree(out, folder / "copy")
    run(scene, *every, "run.max_steps=21", "output.keep_checkpoints=3", "--restart", "out", ranks=2, cwd=folder)
    require(kept() == [10, 15, 20], f"checkpoints after a restart: {kept()}")
    run(scene, *every, "run.max_steps=26", "output.keep_checkpoints=1", "--restart", "out", cwd=folder)
    require(kept() == [25], f"checkpoints after a restart that keeps one: {kept()}")
    shutil.rmtree(out)
    (folder / "copy").rename(out)
    run(scene, *every, "run.max_steps=11", "output.keep_checkpoints=2", "--restart", out / "chk_0000005.h5", cwd=folder)
    require(kept() == [5, 10], f"checkpoints after a restart from an older one: {kept()}")
    say("output.keep_checkpoints: counts those from before a restart")


def main():
    failures = []

    def check(function, *arguments):
        try:
            return function(scratch(), *arguments)
        except Failure as failure:
            failures.append(function.__name__)
            say(f"{function.__name__}: {failure}")

    keys = check(check_command_line) or {2: [], 3: []}
    check(check_check)
    for dim in (2, 3):
        check(check_files, dim, keys)
    check(check_stopping)
    check(check_numerical_failure)
    check(check_output_failures)
    check(check_bad_restarts)
    check(check_kept_checkpoints)
    require(not failures, ", ".join(failures))


main()

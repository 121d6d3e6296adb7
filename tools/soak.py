#!/usr/bin/python3
"""Whether memory stays flat over a long run: resident size of all ranks against steps, with regridding and output all the time.

    soak.py --build build/release [--steps 20000] [--ranks 2] [--out docs/results/soak.csv] [SCENE ...]

Scenes: `carried`, a crystal that a given velocity carries through the mesh and that keeps growing and melting at its sides;
`flow`, a disc that a stream carries and turns (slower by far). Ends with 1 if the resident size after the first tenth of the steps
varies by more than 2 %.
"""
import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
FLAT = 0.02
COMMON = """
[run]
end_time_tau0 = 1e9
max_steps = {steps}
[output]
dir = "{dir}"
plot_every_tau0 = 20
diagnostics_every_tau0 = 2
checkpoint_every_steps = 100
"""
SCENES = {
    "carried": """
[mesh]
dim = 2
size_W0 = [128, 128]
dx_W0 = 1
block_cells = 8
max_regrid_steps = 5
xlo = "periodic"
xhi = "periodic"
ylo = "periodic"
yhi = "periodic"
[phase_field]
frozen = true
rigid = true
[[seed]]
position_W0 = [64, 64]
radius_W0 = 12
[[seed]]
position_W0 = [20, 100]
radius_W0 = 8
angle_deg = 30
[flow]
velocity_W0_tau0 = [1.5, 0.7]
""",
    "flow": """
[mesh]
dim = 2
size_W0 = [64, 64]
dx_W0 = 1
block_cells = 8
max_regrid_steps = 5
xlo = "periodic"
xhi = "periodic"
[phase_field]
frozen = true
rigid = true
[[seed]]
position_W0 = [32, 40]
radius_W0 = 8
[flow]
gravity_um_s2 = 0
solutal_buoyancy = false
max_interval_tau0 = 1
wall_gradient_per_tau0 = [0, 0.1, 0, 0]
""",
}


def resident(pid):
    """MB of a process and all below it that run the program."""
    total, found = 0.0, [pid]
    while found:
        p = found.pop()
        try:
            with open(f"/proc/{p}/task/{p}/children", encoding="ascii") as f:
                found += [int(c) for c in f.read().split()]
            with open(f"/proc/{p}/status", encoding="ascii") as f:
                status = dict(line.split(":", 1) for line in f if ":" in line)
        except (FileNotFoundError, ProcessLookupError):
            continue
        if status["Name"].strip().startswith("dendrift"):
            total += int(status.get("VmRSS", "0 kB").split()[0]) / 1024
    return total


def last_line(path):
    try:
        with open(path, encoding="ascii") as f:
            rows = [r for r in csv.DictReader(f) if None not in r.values()]
        return int(float(rows[-1]["step"])), int(float(rows[-1]["cells"]))
    except (FileNotFoundError, IndexError, ValueError):
        return None


def soak(name, args):
    folder = tempfile.mkdtemp(prefix="dendrift_soak_")
    scene = os.path.join(folder, "scene.toml")
    with open(scene, "w", encoding="utf-8") as f:
        f.write(COMMON.format(steps=args.steps, dir=os.path.join(folder, "out")) + SCENES[name])
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(args.ranks), os.path.join(args.build, "dendrift2d"), scene]
    rows, begin = [], time.time()
    with open(os.path.join(folder, "log"), "w", encoding="utf-8") as log, subprocess.Popen(command, stdout=log, stderr=log) as run:
        while run.poll() is None:
            time.sleep(0.2)
            seen = last_line(os.path.join(folder, "out", "diagnostics.csv"))
            size = resident(run.pid)
            # Plotfiles of a long run would fill the disk.
            plots = sorted(f for f in os.listdir(os.path.join(folder, "out")) if f.startswith("plt_0")) if seen else []
            for f in plots[:-2]:
                os.remove(os.path.join(folder, "out", f))
            if seen and size > 0 and (not rows or seen[0] >= rows[-1]["step"] + args.steps // 100):
                rows.append({"scene": name, "step": seen[0], "cells": seen[1], "resident_MB": round(size, 2)})
    if run.returncode != 0:
        sys.exit(f"{name} ended with {run.returncode}; see {folder}/log")
    late = [r["resident_MB"] for r in rows if r["step"] > args.steps / 10]
    spread = (max(late) - min(late)) / min(late)
    print(f"{name}: {args.steps} steps in {time.time() - begin:.0f} s on {args.ranks} ranks, resident {min(late):.1f} to {max(late):.1f} MB "
          f"after the first tenth ({100 * spread:.2f} %), last {late[-1]:.1f} MB")
    return rows, spread


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--build", default=os.path.join(ROOT, "build", "release"))
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--out", default=os.path.join(ROOT, "docs", "results", "soak.csv"))
    args = parser.parse_args()
    rows, worst = [], 0.0
    for name in args.scenes or SCENES:
        if name not in SCENES:
            sys.exit(f"soak.py: expected {', '.join(SCENES)}, found {name}")
        r, spread = soak(name, args)
        rows += r
        worst = max(worst, spread)
    with open(args.out, "w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    sys.exit(1 if worst > FLAT else 0)


if __name__ == "__main__":
    main()

#!/usr/bin/python3
"""diagnostics.csv, tips.csv and grains.csv of a run with flow are the same through restarts between two solutions of the
flow, when their columns tell of a solution before the restart."""
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import column, read_csv, require, run, say, scratch

SCENE = """
[run]
end_time_tau0 = 1000
max_steps = 126
[mesh]
dim = 2
size_W0 = [64, 64]
block_cells = 8
[[seed]]
position_W0 = [32, 44]
radius_W0 = 8
angle_deg = 20
[flow]
[output]
diagnostics_every_tau0 = 0.5
checkpoint_every_steps = 7
keep_checkpoints = 100
"""


def lines(folder):
    tables = {}
    for name in ("diagnostics.csv", "tips.csv", "grains.csv"):
        header, rows = read_csv(folder / name)
        wall = header.index("wall_s") if "wall_s" in header else len(header)
        tables[name] = [row[:wall] + row[wall + 1:] for row in [header, *rows]]
    return tables


folder = scratch()
(folder / "scene.toml").write_text(SCENE)
run("scene.toml", "output.dir=whole", cwd=folder)
reference = lines(folder / "whole")
steps = column(folder / "whole/diagnostics.csv", "step", int)
told = [(row[-1], row[-3]) for row in read_csv(folder / "whole/diagnostics.csv")[1]]  # changes with each solution
between = 0
for checkpoint in sorted((folder / "whole").glob("chk_*.h5"))[1:]:
    step = int(checkpoint.stem[4:])
    before, after = max(i for i, s in enumerate(steps) if s <= step), min(i for i, s in enumerate(steps) if s > step)
    between += told[before] == told[after]
    shutil.copytree(folder / "whole", folder / "again")
    run("scene.toml", "output.dir=again", "--restart", folder / "again" / checkpoint.name, cwd=folder)
    for name, table in lines(folder / "again").items():
        wrong = [(a, b) for a, b in zip(reference[name], table) if a != b]
        require(table == reference[name], f"{name} after a restart from step {step}: {wrong[:2]}")
    shutil.rmtree(folder / "again")
require(between >= 3, f"only {between} restarts lie between two solutions of the flow: {told}")
say(f"the same lines after every restart, {between} of them between two solutions of the flow")

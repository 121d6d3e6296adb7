#!/usr/bin/python3
"""The same bits on any number of ranks and threads, with either partitioner, and through a restart on other numbers of
them: checkpoints, diagnostics.csv (but wall_s), tips.csv and the last plotfile (but the owners).

Arguments: BUILD SOURCE [STEPS [SCENE...]]. With STEPS (200, say): each scene for so many steps in one go, and half of them, a
restart, and the rest, on one rank and on others."""
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import Failure, checkpoint_bits, column, differences, fail, read_csv, require, run, say, scratch

# Small scenes, but with three to five levels and with fronts that make the mesh change every few steps. The last step
# is one after a checkpoint: a run that ends writes none.
COMMON = """
[output]
checkpoint_every_steps = {every}
keep_checkpoints = 100
diagnostics_every_tau0 = {lines}
[run]
end_time_tau0 = 1000
max_steps = {steps}
[alloy]
supersaturation = {omega}
"""
MESH_2D = """
[mesh]
dim = 2
block_cells = 8
max_regrid_steps = 4
"""
MESH_3D = """
[mesh]
dim = 3
size_W0 = [64, 64, 64]
root_blocks = [1, 1, 1]
levels = 4
block_cells = 8
max_regrid_steps = 3
"""
PERIODIC_3D = "".join(f'{axis}{end} = "periodic"\n' for axis in "xyz" for end in ("lo", "hi"))
TALL = MESH_2D + """
size_W0 = [64, 128]
root_blocks = [1, 2]
levels = 4
"""
# a growing crystal that sinks and turns, melt that flows; the table [flow] stays open
SINKING = TALL + """
[[seed]]
position_W0 = [28, 80]
radius_W0 = 8
angle_deg = 20
[flow]
max_interval_tau0 = 0.4
gravity_um_s2 = 3e9
"""
SCENES = {
    # two turned crystals, noise, and all kinds of sides
    "2D growth": (dict(lines=1, steps=81, omega=0.3), MESH_2D + """
size_W0 = [256, 128]
root_blocks = [2, 1]
levels = 5
xlo = "periodic"
xhi = "periodic"
ylo = "symmetry"
yhi = "open"
[phase_field]
noise = 0.05
[[seed]]
position_W0 = [80, 50]
radius_W0 = 6
angle_deg = 20
[[seed]]
position_W0 = [180, 80]
radius_W0 = 5
angle_deg = 20
"""),
    # two crystals of different angle that grow together and turn with the flow: the field of angles is carried and solved
    "2D orientation": (dict(lines=0.5, steps=81, omega=0.35), """
[mesh]
dim = 2
size_W0 = [128, 64]
root_blocks = [2, 1]
levels = 4
block_cells = 8
max_regrid_steps = 4
[[seed]]
position_W0 = [54, 32]
radius_W0 = 9
angle_deg = 10
[[seed]]
position_W0 = [74, 30]
radius_W0 = 9
angle_deg = 50
[orientation]
max_dt_tau0 = 0.5
[flow]
velocity_gradient_per_tau0 = [0, -0.02, 0.02, 0]
"""),
    # a crystal carried across both pairs of periodic sides
    "2D drift": (dict(lines=2, steps=129, omega=0.3), MESH_2D + """
size_W0 = [128, 64]
root_blocks = [2, 1]
levels = 4
xlo = "periodic"
xhi = "periodic"
ylo = "periodic"
yhi = "periodic"
[[seed]]
position_W0 = [64, 32]
radius_W0 = 6
[flow]
velocity_W0_tau0 = [4, 2]
"""),
    "2D flow": (dict(lines=0.5, steps=105, omega=0.4), SINKING),
    "2D flow on a coarser mesh": (dict(lines=0.5, steps=81, omega=0.4), SINKING + "coarser_levels = 1"),
    "2D flow, penalised": (dict(lines=0.5, steps=81, omega=0.4), SINKING + 'solid = "penalised"\ntolerance = 1e-7'),
    "2D flow, held": (dict(lines=0.5, steps=81, omega=0.4), SINKING + 'motion = "held"\ncoupling = "projection"'),
    # crystals of several orientations that sink, touch, and appear later
    "2D grains": (dict(lines=0.5, steps=81, omega=0.4), TALL + """
[[seed]]
position_W0 = [22, 80]
radius_W0 = 8
angle_deg = 20
[[seed]]
position_W0 = [40, 80]
radius_W0 = 8
angle_deg = 60
[[seed]]
position_W0 = [30, 30]
radius_W0 = 5
angle_deg = 70
nucleation_time_tau0 = 2
[flow]
max_interval_tau0 = 0.4
gravity_um_s2 = 3e9
coarser_levels = 1
"""),
    # melt that comes in, goes out and shears, and a crystal of another shape
    "2D shear": (dict(lines=0.5, steps=81, omega=0.4), TALL + """
yhi = "open"
[[seed]]
position_W0 = [28, 80]
radius_W0 = 8
aspect_ratio = 1.5
angle_deg = 20
[flow]
wall_gradient_per_tau0 = [0.02, 0.03, 0.01, -0.02]
ylo_velocity_W0_tau0 = [0, 0.4]
ylo_profile = "parabolic"
max_interval_tau0 = 0.4
gravity_um_s2 = 1e7
"""),
    "3D growth": (dict(lines=0.2, steps=41, omega=0.3), MESH_3D + """
xlo = "wall"
xhi = "open"
ylo = "symmetry"
yhi = "wall"
zlo = "periodic"
zhi = "periodic"
[phase_field]
noise = 0.05
[[seed]]
position_W0 = [18.3, 3.1, 21.7]
radius_W0 = 6
euler_deg = [10, 30, 50]
"""),
    # crystals in touch, and one that comes later, carried across periodic sides
    "3D grains": (dict(lines=0.2, steps=65, omega=0.3), MESH_3D + PERIODIC_3D + """
[[seed]]
position_W0 = [24, 32, 32]
radius_W0 = 5
euler_deg = [10, 30, 50]
[[seed]]
position_W0 = [33, 32, 32]
radius_W0 = 5
[[seed]]
position_W0 = [32, 10, 12]
radius_W0 = 4
nucleation_time_tau0 = 1
[flow]
velocity_W0_tau0 = [3, 1, -2]
"""),
    # a crystal that sinks and turns between walls: the flow is solved
    "3D flow": (dict(lines=0.1, steps=57, omega=0.3), MESH_3D + """
[[seed]]
position_W0 = [26, 32, 40]
radius_W0 = 8
euler_deg = [10, 30, 50]
[flow]
max_interval_tau0 = 0.2
gravity_um_s2 = 3e10
"""),
    "3D drift": (dict(lines=0.2, steps=33, omega=0.2), MESH_3D + PERIODIC_3D + """
[[seed]]
position_W0 = [32, 32, 32]
radius_W0 = 5
[flow]
velocity_W0_tau0 = [6, 3, -2]
"""),
}
FEW_RUNS = [(2, 2, "curve"), (4, 1, "curve"), (4, 2, "graph")]  # of variants of a scene
RUNS = {  # ranks, threads, partitioner
    "2D": [(1, 2, "curve"), (2, 1, "graph"), (2, 2, "curve"), (4, 1, "curve"), (4, 2, "graph"), (8, 1, "curve"),
           (8, 2, "graph")],
    "3D": [(1, 2, "curve"), (2, 2, "curve"), (4, 1, "curve"), (4, 2, "graph"), (8, 1, "graph")]}
RESTARTS = [(4, 1, "graph"), (1, 2, "curve")]


def rows_but_wall(path):
    header, rows = read_csv(path)
    wall = header.index("wall_s")
    return [r[:wall] + r[wall + 1:] for r in [header, *rows]]


def plotfile_bits(path):
    """Boxes and values of all blocks; and who owns them, apart."""
    bits, owners = {}, []
    with h5py.File(path) as file:
        names = [file.attrs[f"component_{i}"] for i in range(file.attrs["num_components"])]
        names = [n.decode() if isinstance(n, bytes) else str(n) for n in names]
        for level in range(file.attrs["num_levels"]):
            group = file[f"level_{level}"]
            boxes = group["boxes"][()]
            values = group["data:datatype=0"][()].reshape(len(boxes), len(names), -1)
            bits[f"boxes of level {level}"] = boxes.tobytes()
            for i, name in enumerate(names):
                if name != "rank":
                    bits[f"{name} on level {level}"] = values[:, i].tobytes()
            owners.append(values[:, names.index("rank"), 0])
    return bits, np.concatenate(owners).astype(int)


class Output:
    """All that a run left and that may not depend on how it was run."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.diagnostics = rows_but_wall(self.folder / "diagnostics.csv")
        self.tips = read_csv(self.folder / "tips.csv")
        self.checkpoints = {p.name: checkpoint_bits(p) for p in sorted(self.folder.glob("chk_*.h5"))}
        self.plot, self.owners = plotfile_bits(max(self.folder.glob("plt_*.hdf")))

    def require_same(self, other, name):
        require(other.diagnostics == self.diagnostics,
                f"{name}: diagnostics.csv differs, first in {first_difference(self.diagnostics, other.diagnostics)}")
        require(other.tips == self.tips,
                f"{name}: tips.csv differs, first in {first_difference(self.tips[1], other.tips[1])}")
        require(other.checkpoints.keys() == self.checkpoints.keys(),
                f"{name}: checkpoints {list(other.checkpoints)} where {list(self.checkpoints)} were expected")
        for file, bits in self.checkpoints.items():
            wrong = differences(bits, other.checkpoints[file])
            require(not wrong, f"{name}: {file} differs in {wrong}")
        wrong = differences(self.plot, other.plot)
        require(not wrong, f"{name}: the last plotfile differs in {wrong}")


def first_difference(a, b):
    return next(((x, y) for x, y in zip(a, b) if x != y), f"their lengths, {len(a)} and {len(b)} lines")


def check_scene(name, numbers, text, steps=None):
    folder = scratch()
    scene = folder / "scene.toml"
    numbers = dict(numbers, every=8) if steps is None else dict(numbers, every=steps // 2, steps=steps + 1)
    scene.write_text(COMMON.format(**numbers) + text)

    def go(where, ranks, threads, partitioner, *words):
        # Costs of blocks are measured: on a busy machine blocks may look so alike that none would move.
        run(scene, f"output.dir={folder / where}", f"parallel.partitioner={partitioner}", "parallel.max_imbalance=1", *words,
            ranks=ranks if ranks > 1 else 0, threads=threads, cwd=folder)
        return Output(folder / where)

    reference = go("reference", 1, 1, "curve")
    # Without several levels, regrids and tips the comparison would be of little.
    blocks = column(folder / "reference/diagnostics.csv", "blocks", int)
    changes = sum(a != b for a, b in zip(blocks, blocks[1:]))
    levels = max(column(folder / "reference/diagnostics.csv", "levels", int))
    require(changes >= 3 and levels >= 3,
            f"{name}: {changes} changes of the number of blocks {blocks}, {levels} levels")
    require(len(reference.checkpoints) >= (3 if steps is None else 2), f"{name}: only {len(reference.checkpoints)} checkpoints")
    require(len(reference.tips[1]) >= 4 * len(reference.diagnostics) // 2, f"{name}: too few tips found")

    # The comparison sees what must differ: other random numbers.
    if "noise" in text:
        try:
            reference.require_same(go("other noise", 1, 1, "curve", "phase_field.noise_seed=2"), "control")
        except Failure:
            pass
        else:
            fail(f"{name}: another noise_seed changes nothing")

    owners = {}
    runs = FEW_RUNS if steps is not None or name.startswith(("2D flow ", "2D flow,", "3D flow")) else RUNS[name[:2]]
    for ranks, threads, partitioner in runs:
        label = f"{ranks}r{threads}t_{partitioner}"
        output = go(label, ranks, threads, partitioner)
        reference.require_same(output, f"{name}, {ranks} ranks, {threads} threads, {partitioner}")
        require(len(set(output.owners)) == ranks, f"{name}: only ranks {set(output.owners)} of {ranks} own blocks")
        owners[label] = output.owners
    require(steps is not None or (owners["4r1t_curve"] != owners["4r2t_graph"]).any(), f"{name}: curve and graph give the same owners")

    # From the middle: what the reference wrote later is not removed, but for the checkpoints.
    kept = list(reference.checkpoints)[: len(reference.checkpoints) // 2]
    for source, (ranks, threads, partitioner) in zip(("reference", label), RESTARTS):
        where = f"restart_on_{ranks}r{threads}t"
        shutil.copytree(folder / source, folder / where)
        for file in (folder / where).glob("chk_*.h5"):
            if file.name not in kept:
                file.unlink()
        (folder / where / max((folder / where).glob("plt_*.hdf")).name).unlink()
        output = go(where, ranks, threads, partitioner, "--restart", folder / where)
        reference.require_same(output, f"{name}, from {kept[-1]} of {source} on {ranks} ranks, {threads} threads")
    shutil.rmtree(folder)
    say(f"{name}: {levels} levels, blocks {min(blocks)} to {max(blocks)} in {changes} changes; the same bits in "
        f"{len(runs)} runs and {len(RESTARTS)} restarts")


def main():
    failures = []
    for name, (numbers, text) in SCENES.items():
        if sys.argv[4:] and name not in sys.argv[4:]:
            continue
        try:
            check_scene(name, numbers, text, *map(int, sys.argv[3:4]))
        except Failure as failure:
            failures.append(name)
            say(f"{failure}")
    require(not failures, f"{', '.join(failures)}")


main()

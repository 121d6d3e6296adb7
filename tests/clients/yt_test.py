#!/usr/bin/python3
"""yt opens the plotfiles, in 2D and 3D, and finds in them what diagnostics.csv says: integrals over the leaves, numbers
of cells, blocks and levels, time and size."""
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import read_csv, require, run, say, scratch

try:
    import numpy as np
    import yt
except ImportError as error:
    print(f"skipped: {error}")
    sys.exit(77)

SCENES = {
    2: """
[mesh]
dim = 2
size_W0 = [128, 64]
root_blocks = [2, 1]
levels = 4
block_cells = 8
[[seed]]
position_W0 = [90, 20]
radius_W0 = 6
""", 3: """
[mesh]
dim = 3
size_W0 = [64, 64, 32]
root_blocks = [2, 2, 1]
levels = 3
block_cells = 8
[[seed]]
position_W0 = [40, 20, 12]
radius_W0 = 5
"""}
COMMON = """
[run]
end_time_tau0 = 6
[output]
plot_every_tau0 = 3
diagnostics_every_tau0 = 1
"""
# Defaults of [alloy], and what follows: wt% in the liquid at the interface, um per W0.
K, SUPERSATURATION, C0_WT, SLOPE, GIBBS_THOMSON, W0_OVER_D0 = 0.14, 0.2, 4.0, 2.65, 0.236, 10
C_L = C0_WT / (1 - (1 - K) * SUPERSATURATION)
W0_UM = W0_OVER_D0 * GIBBS_THOMSON / (SLOPE * C_L * (1 - K))
SIZE_W0 = {2: [128, 64], 3: [64, 64, 32]}
SUM_TOLERANCE = 1e-9  # yt adds 1e4 to 1e5 numbers one after the other, with errors of 1e-16 each


def relative(found, expected):
    return abs(found - expected) / abs(expected)


def check_plotfile(path, dim, rows, ranks):
    ds = yt.load(str(path))
    require(type(ds).__name__ == "ChomboDataset", f"{path.name}: yt takes it for a {type(ds).__name__}")
    data = ds.all_data()
    field = {name: np.asarray(data["chombo", name]) for _, name in ds.field_list}
    row = rows[int(path.stem.split("_")[1])]
    where = f"{path.name} ({dim}D)"

    velocities = ["velocity_x", "velocity_y", "velocity_z"][:dim]
    wanted = {"phi", "U", "c", "alpha", *velocities, "pressure", "level", "rank", "grain"}
    require(wanted <= field.keys(), f"{where}: no field {sorted(wanted - field.keys())}")
    for name, values in field.items():
        require(np.isfinite(values).all(), f"{where}: {name} is not finite everywhere")

    cell_level = np.asarray(data["index", "grid_level"]).astype(int)
    cells, blocks, side = len(cell_level), 0, 8
    require(cells == int(row["cells"]), f"{where}: {cells} cells, diagnostics.csv has {row['cells']}")
    for level in range(ds.index.max_level + 1):
        count = int((cell_level == level).sum())
        require(count % side**dim == 0, f"{where}: {count} visible cells on level {level} are not whole blocks")
        blocks += count // side**dim
    require(blocks == int(row["blocks"]), f"{where}: {blocks} leaves, diagnostics.csv has {row['blocks']}")
    require(ds.index.max_level + 1 == int(row["levels"]), f"{where}: {ds.index.max_level + 1} levels")
    # Every block of the tree is there: each refined one has 2^dim children.
    roots = int(np.prod([int(n) // side for n in ds.domain_dimensions[:dim]]))
    require(len(ds.index.grids) == blocks + (blocks - roots) // (2**dim - 1),
            f"{where}: {len(ds.index.grids)} blocks in the tree of {blocks} leaves")
    require((field["level"] == cell_level).all(), f"{where}: the field 'level' is not the level")
    require(set(field["rank"]) == set(range(ranks)), f"{where}: ranks {set(field['rank'])} instead of {ranks}")
    require(set(field["grain"]) == {-1.0, 0.0} and ((field["grain"] >= 0) == (field["phi"] > 0)).all(),
            f"{where}: 'grain' is not 0 in the crystal and -1 outside")

    volume = np.prod([np.asarray(data["index", "d" + axis]) for axis in "xyz"[:dim]], axis=0)
    box = float(np.prod(np.asarray(ds.domain_width)[:dim]))
    width = np.asarray(ds.domain_width)[:dim]
    require(np.allclose(width, W0_UM * np.array(SIZE_W0[dim]), rtol=1e-12), f"{where}: a box of {width} um")
    require(relative(volume.sum(), box) < SUM_TOLERANCE, f"{where}: the leaves do not fill the box")
    means = {"solid_fraction": (volume * 0.5 * (1 + field["phi"])).sum() / box,
             "solute_mean_wt": (volume * field["c"]).sum() / box}
    for name, found in means.items():
        require(relative(found, float(row[name])) < SUM_TOLERANCE,
                f"{where}: {name} is {found!r}, diagnostics.csv has {row[name]}")
    require(relative(float(ds.current_time) + 1, float(row["time_s"]) + 1) < 1e-15, f"{where}: time {ds.current_time}")

    # U, c and phi are one state: c/c_l = (1 + k - (1-k) phi)/2 [1 + (1-k) U].
    c = C_L * 0.5 * (1 + K - (1 - K) * field["phi"]) * (1 + (1 - K) * field["U"])
    require(np.abs(c / field["c"] - 1).max() < 1e-12, f"{where}: U, c and phi contradict each other")
    return cells, len(ds.index.grids)


def main():
    yt.set_log_level(50)
    for dim, scene in SCENES.items():
        folder = scratch()
        (folder / "scene.toml").write_text(COMMON + scene)
        run("scene.toml", "output.dir=out", ranks=2, cwd=folder)
        header, rows = read_csv(folder / "out/diagnostics.csv")
        rows = {int(r[0]): dict(zip(header, r)) for r in rows}
        series = json.loads((folder / "out/plt.hdf.series").read_text())
        files = [folder / "out" / entry["name"] for entry in series["files"]]
        require(len(files) == 3, f"{dim}D: {len(files)} plotfiles, three were asked for")
        seen = [check_plotfile(file, dim, rows, 2) for file in files]
        require(len({cells for cells, _ in seen}) > 1, f"{dim}D: the mesh never changed")
        say(f"{dim}D: {len(files)} plotfiles, {seen[-1][0]} cells, {seen[-1][1]} blocks in the last: fields, "
            "integrals, counts, time and U(c, phi) as in diagnostics.csv")


main()

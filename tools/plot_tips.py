#!/usr/bin/python3
"""Tips, solid fraction, cells and solute drift of a run against time, as one PNG.

    plot_tips.py out [--grain 3] [--out tips.png]

Reads tips.csv and diagnostics.csv of the folder, and grains.csv for the lengths of the arms. Whatever of
them is there is drawn, so a run that is still going, or was killed, can be looked at.
"""
import argparse
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.colors import ListedColormap, Normalize  # noqa: E402


class InputError(Exception):
    """What is wrong, in one line."""


def read_csv(path, needed):
    """Columns by name; a line cut short by a killed run is dropped."""
    if not path.is_file():
        return None
    with open(path, encoding="utf-8") as file:
        names = [name.strip() for name in file.readline().split(",")]
        missing = [name for name in needed if name not in names]
        if missing:
            raise InputError(f"{path}: no column '{missing[0]}'; it has {', '.join(names)}")
        rows = []
        for line in file:
            if not line.endswith("\n"):
                continue
            try:
                rows.append([float(value) for value in line.split(",")])
            except ValueError:
                continue
    rows = [row for row in rows if len(row) == len(names)]
    return dict(zip(names, np.array(rows).reshape(-1, len(names)).T)) if rows else None


def select(table, rows):
    return {name: column[rows] for name, column in table.items()}


def last_written(table):
    """After a restart times repeat: of lines for the same time on, those written last count."""
    time = table["time_s"]
    later = np.append(np.minimum.accumulate(time[::-1])[::-1][1:], np.inf)
    return select(table, time < later)


def arms_of(tips, grains, only):
    """One dict an arm: label, angle to gravity, and against time the position, arm length, and speed."""
    arms, axes = [], [f"{a}_um" for a in "xyz" if f"{a}_um" in tips]
    for grain, arm in sorted({(g, a) for g, a in zip(tips["grain"], tips["arm"])}):
        if only is not None and grain != only:
            continue
        own = last_written(select(tips, (tips["grain"] == grain) & (tips["arm"] == arm)))
        place = np.stack([own[a] for a in axes])
        centre = place[:, :1]  # without grains.csv: the way from where the tip was first seen
        if grains is not None and (grains["grain"] == grain).any():
            path = last_written(select(grains, grains["grain"] == grain))
            centre = np.stack([np.interp(own["time_s"], path["time_s"], path[a]) for a in axes])
        angle = own["euler_deg"]
        arms.append({"grain": int(grain), "arm": int(arm), "angle": abs((angle[0] + 180) % 360 - 180),
                     "t": own["time_s"], "height": place[-1], "speed": own["speed_um_s"],
                     "length": np.linalg.norm(place - centre, axis=0)})
    return arms, axes[-1][0]


def draw_tips(fig, panels, arms, vertical, has_grains):
    """Few arms: a colour each and a legend. Many: coloured by their angle to gravity."""
    few, many_grains = len(arms) <= 8, len({arm["grain"] for arm in arms}) > 1
    shades = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0, 0.93, 256)))  # the last yellow is too pale
    colours = matplotlib.colormaps["tab10"].colors
    keys = {"height": f"tip position {vertical} (µm)", "speed": "tip speed along the arm (µm/s)",
            "length": "arm length, centre to tip (µm)" if has_grains else "way of the tip from its start (µm)"}
    for ax, (key, label) in zip(panels, keys.items()):
        for number, arm in enumerate(arms):
            name = f"arm {arm['arm']} ({arm['angle']:.0f}°)"
            ax.plot(arm["t"], arm[key], label=f"grain {arm['grain']}, {name}" if many_grains else name,
                    lw=1.3 if few else 0.9, marker="." if len(arm["t"]) < 3 else None,
                    ls=("-", "--", ":", "-.")[number // 2] if few else "-",  # an equal arm shows through the gaps
                    color=colours[number] if few else shades(arm["angle"] / 180))
        ax.set_ylabel(label)
    # The first moments, of a seed not yet in its shape, would set the scale of all that follows.
    speeds = np.concatenate([arm["speed"][np.isfinite(arm["speed"])] for arm in arms])
    if speeds.size > 50:
        lo, hi = np.percentile(speeds, [0.5, 99.5])
        margin = 0.25 * (hi - lo) or 1
        inside = speeds[(speeds > lo - margin) & (speeds < hi + margin)]
        panels[1].set_ylim(inside.min() - 0.2 * margin, inside.max() + 0.2 * margin)
    if few:
        panels[0].legend(fontsize=7, frameon=False, title="angle to gravity in ( )", title_fontsize=7)
    else:
        bar = fig.colorbar(matplotlib.cm.ScalarMappable(Normalize(0, 180), shades), ax=panels,
                           ticks=range(0, 181, 45), fraction=0.012, pad=0.008)
        bar.set_label("angle to gravity at start (deg)", fontsize=8)
        bar.outline.set_linewidth(0.5)


def draw_diagnostics(panels, table):
    time = table["time_s"]
    panels[0].plot(time, table["solid_fraction"], color="#3c5f8a")
    panels[0].set_ylabel("solid fraction")
    panels[1].plot(time, table["cells"] / 1e3, color="#3c5f8a")
    panels[1].set_ylabel("cells (thousands)")
    panels[1].set_ylim(bottom=0)
    drift = np.abs(table["solute_drift_rel"])
    panels[2].set_ylabel("|solute drift|, relative")
    if (drift > 0).any():
        panels[2].semilogy(time, np.where(drift > 0, drift, np.nan), color="#b5533c", lw=1.0)
        panels[2].axhline(np.finfo(float).eps, color="0.6", lw=0.6, ls="--")
        panels[2].text(0.99, np.finfo(float).eps * 1.1, "round-off", transform=panels[2].get_yaxis_transform(),
                       ha="right", va="bottom", fontsize=7, color="0.45")
    else:
        panels[2].plot(time, drift, color="#b5533c")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    def refuse(message):
        raise InputError(message)

    parser.error = refuse
    parser.add_argument("folder", metavar="DIR", type=Path)
    parser.add_argument("--grain", type=int, help="only this grain's arms")
    parser.add_argument("--out", type=Path, metavar="PNG", help="default: DIR/tips.png")
    opt = parser.parse_args()
    if not opt.folder.is_dir():
        raise InputError(f"{opt.folder}: no such folder")

    tips = read_csv(opt.folder / "tips.csv", ["time_s", "grain", "arm", "euler_deg", "x_um", "y_um", "speed_um_s"])
    grains = read_csv(opt.folder / "grains.csv", ["time_s", "grain", "x_um", "y_um"])
    table = read_csv(opt.folder / "diagnostics.csv", ["time_s", "solid_fraction", "cells", "solute_drift_rel"])
    if tips is None and table is None:
        raise InputError(f"{opt.folder}: neither tips.csv nor diagnostics.csv is there with a line of data in it")
    for name, found in (("tips.csv", tips), ("diagnostics.csv", table)):
        if found is None:
            print(f"{opt.folder}: {name} is missing or has no line of data yet: left out")

    plt.rcParams.update({"font.size": 8, "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
                         "lines.linewidth": 1.3, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "axes.grid": True,
                         "grid.color": "0.92", "grid.linewidth": 0.6})
    rows = (tips is not None) + (table is not None)
    fig, axes = plt.subplots(rows, 3, figsize=(10, 2.75 * rows), dpi=180, layout="constrained", squeeze=False,
                             sharex=True)
    if tips is not None:
        arms, vertical = arms_of(tips, grains, opt.grain)
        if not arms:
            raise InputError(f"{opt.folder}/tips.csv: no grain {opt.grain}; it has "
                             f"{', '.join(str(int(g)) for g in np.unique(tips['grain']))}")
        draw_tips(fig, axes[0], arms, vertical, grains is not None)
    if table is not None:
        draw_diagnostics(axes[-1], last_written(table))
    for ax in axes.flat:
        ax.margins(x=0.02)
        ax.tick_params(length=2.5)
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    out = opt.out or opt.folder / "tips.png"
    try:
        fig.savefig(out)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write {out}: {error}") from None
    print(out)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as problem:
        print(f"plot_tips.py: {problem}", file=sys.stderr)
        sys.exit(2)

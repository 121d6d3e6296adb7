#!/usr/bin/python3
"""Curves of figures 1 to 5 of Qi et al. (2017) from runs of inputs/paper/fig1_*.toml and fig5_no_solutal.toml.

    figure1.py --mobile out/fig1_mobile --stationary out/fig1_stationary [--diffusion out/fig1_diffusion]
               [--no-solutal out/fig5_no_solutal] [--every 0.01] [--out docs/figures/fig1_curves.png]

Length of the arms, speeds of the tips and of the crystal, largest speed of the melt against time, as a PNG, and the same
numbers as docs/results/fig1_{mobile,stationary,diffusion}.csv and fig5_no_solutal.csv; composition and flow at the times that the paper shows, with its isolines
(c every .1 wt% from 4.05; speed every 100 um/s, or 10 in the stationary case), as docs/figures/fig1_{mobile,stationary}.png.
Runs that are still going, or were stopped, are drawn as far as they are.
"""
import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from plotfile import Plotfile, find_plotfiles  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
SHOWN = {"mobile": ((0.32, 0.85, 1.22), 100.0), "stationary": ((0.53, 1.06, 1.96), 10.0)}  # times (s), speeds apart (um/s)


def read(path):
    """Whole lines; a restarted run may have more columns than before, a killed one half a line at the end."""
    with open(path, encoding="utf-8") as file:
        rows = [{k: float(v) for k, v in row.items() if k and v} for row in csv.DictReader(file)]
    return [r for r in rows if len(r) >= len(rows[0])]


def table(folder, every):
    """A line each `every` seconds: what the figures show."""
    tips, grains = {}, {}
    for row in read(folder / "tips.csv"):
        tips.setdefault(round(row["time_s"], 9), {})[round(row["euler_deg"] / 90) * 90, row["x_um"] > 428.7] = row
    for row in read(folder / "grains.csv"):
        grains[round(row["time_s"], 9)] = row
    out, aside, spin = [], 0.0, 0.0  # the most since the last line
    for row in read(folder / "diagnostics.csv"):
        t = round(row["time_s"], 9)
        if t in grains:
            aside, spin = max(aside, grains[t]["vx_um_s"], key=abs), max(spin, grains[t]["omega_rad_s"], key=abs)
        if abs(t / every - round(t / every)) > 1e-6 or t not in grains:
            continue
        at = tips.get(t, {})
        pick = lambda angle: next((v for (a, _), v in sorted(at.items()) if a == angle), None)
        line = {"time_s": t, "settling_um_s": -grains[t]["vy_um_s"], "y_um": grains[t]["y_um"],
                "max_speed_um_s": row["max_speed_um_s"], "area_um2": grains[t]["area_um2"]}
        for name, angle in (("down", 0), ("side", 90), ("up", 180)):
            line[f"tip_{name}_um_s"] = pick(angle)["speed_um_s"] if pick(angle) else float("nan")
            line[f"arm_{name}_um"] = (abs(pick(angle)["y_um"] - grains[t]["y_um"]) if angle != 90 else abs(pick(angle)["x_um"] - grains[t]["x_um"])) if pick(angle) else float("nan")
        line.update(aside_um_s=aside, omega_rad_s=spin, x_um=grains[t]["x_um"], angle_rad=grains[t]["angle_rad"])
        aside = spin = 0.0
        out.append(line)
    return out


def draw_fields(name, folder, out):
    """Composition above, speed below, at the paper's times or as close to them as there are plotfiles."""
    times, apart = SHOWN[name]
    stored = {}
    for path in find_plotfiles(folder):
        with Plotfile(path) as plot:
            stored[plot.time_s] = path
    chosen = sorted({min(stored, key=lambda t: abs(t - wanted)) for wanted in times})
    figure, axes = plt.subplots(2, len(chosen), figsize=(3 * len(chosen), 9), squeeze=False, constrained_layout=True,
                                sharex=True, sharey=True)
    for column, time in zip(axes.T, chosen):
        with Plotfile(stored[time]) as plot:
            level = plot.level_for(1500)
            phi, (x0, x1, y0, y1) = plot.uniform("phi", level, smooth=True)
            c = np.where(phi > -0.9, np.nan, plot.uniform("c", level, smooth=True)[0])
            speed = np.hypot(*(plot.uniform(f"velocity_{a}", level, smooth=True)[0] for a in "xy"))
        x, y = (a + (np.arange(m) + 0.5) * (b - a) / m for a, b, m in ((x0, x1, phi.shape[1]), (y0, y1, phi.shape[0])))
        for axis, data, colours, limits, isolines in (
                (column[0], c, "viridis", (4.0, 4.85), np.arange(4.05, 5, 0.1)),
                (column[1], speed, "Blues", (0, None), np.arange(apart, speed.max(), apart))):
            image = axis.imshow(data, origin="lower", extent=(x0, x1, y0, y1), cmap=colours, vmin=limits[0], vmax=limits[1])
            axis.contour(x, y, data, levels=isolines, colors="white" if axis is column[0] else "tab:red", linewidths=0.5)
            axis.contour(x, y, phi, levels=[0], colors="k", linewidths=0.8)
            figure.colorbar(image, ax=axis, shrink=0.7)
        column[0].set_title(f"{time:.2f} s: c (wt%)", fontsize=10)
        column[1].set_xlabel("x (µm)")
        column[1].set_title("speed (µm/s)", fontsize=10)
    for axis in axes[:, 0]:
        axis.set_ylabel("y (µm)")
    figure.savefig(out, dpi=100)
    plt.close(figure)
    print(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mobile", type=Path)
    parser.add_argument("--stationary", type=Path)
    parser.add_argument("--diffusion", type=Path)
    parser.add_argument("--no-solutal", type=Path)
    parser.add_argument("--every", type=float, default=0.01)
    parser.add_argument("--out", type=Path, default=ROOT / "docs/figures/fig1_curves.png")
    args = parser.parse_args()
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), constrained_layout=True)
    for name, folder, style in (("fig1_mobile", args.mobile, "-"), ("fig1_stationary", args.stationary, "--"),
                                ("fig1_diffusion", args.diffusion, ":"), ("fig5_no_solutal", args.no_solutal, "-.")):
        if folder is None:
            continue
        rows, case = table(folder, args.every), name.split("_", 1)[1]
        with open(ROOT / f"docs/results/{name}.csv", "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows({k: f"{v:.6g}" for k, v in row.items()} for row in rows)
        curve = lambda key: [r[key] for r in rows]
        t = curve("time_s")
        if case in SHOWN:
            draw_fields(case, folder, args.out.with_name(f"{name}.png"))
            for key, colour in (("down", "tab:red"), ("side", "tab:green"), ("up", "tab:blue")):
                axes[0, 0].plot(t, curve(f"tip_{key}_um_s"), style, color=colour, label=f"{key}, {case}")
                axes[0, 1].plot(t, curve(f"arm_{key}_um"), style, color=colour)
            axes[1, 0].semilogy(t[1:], curve("max_speed_um_s")[1:], style, color="k", label=case)
        elif case == "diffusion":  # four equal arms
            axes[0, 0].plot(t, curve("tip_up_um_s"), style, color="k", label=case)
            axes[0, 1].plot(t, curve("arm_up_um"), style, color="k")
        if case in ("mobile", "no_solutal"):
            axes[1, 1].plot(t, curve("settling_um_s"), style, color="k", label=case.replace("no_solutal", "without solutal convection"))
    for axis, label in zip(axes.flat, ("tip speed (µm/s)", "arm (µm)", "largest speed (µm/s)", "settling speed (µm/s)")):
        axis.set_xlabel("t (s)")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylim(0, 200)
    for axis in (axes[0, 0], axes[1, 0], axes[1, 1]):
        axis.legend(fontsize=8)
    figure.savefig(args.out, dpi=110)
    print(args.out)


if __name__ == "__main__":
    main()

#!/usr/bin/python3
"""Curves of figures 1 to 5 of Qi et al. (2017) from runs of inputs/paper/fig1_mobile.toml and fig1_stationary.toml.

    figure1.py --mobile out/fig1_mobile --stationary out/fig1_stationary [--every 0.01] [--out docs/figures/fig1_curves.png]

Length of the arms, speeds of the tips and of the crystal, largest speed of the melt against time, as a PNG, and the same
numbers as docs/results/fig1_{mobile,stationary}.csv. Runs that are still going, or were stopped, are drawn as far as they are.
"""
import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent


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
    out = []
    for row in read(folder / "diagnostics.csv"):
        t = round(row["time_s"], 9)
        if abs(t / every - round(t / every)) > 1e-6 or t not in grains:
            continue
        at = tips.get(t, {})
        pick = lambda angle: next((v for (a, _), v in sorted(at.items()) if a == angle), None)
        line = {"time_s": t, "settling_um_s": -grains[t]["vy_um_s"], "y_um": grains[t]["y_um"],
                "max_speed_um_s": row["max_speed_um_s"], "area_um2": grains[t]["area_um2"]}
        for name, angle in (("down", 0), ("side", 90), ("up", 180)):
            line[f"tip_{name}_um_s"] = pick(angle)["speed_um_s"] if pick(angle) else float("nan")
            line[f"arm_{name}_um"] = (abs(pick(angle)["y_um"] - grains[t]["y_um"]) if angle != 90 else abs(pick(angle)["x_um"] - grains[t]["x_um"])) if pick(angle) else float("nan")
        out.append(line)
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mobile", type=Path)
    parser.add_argument("--stationary", type=Path)
    parser.add_argument("--every", type=float, default=0.01)
    parser.add_argument("--out", type=Path, default=ROOT / "docs/figures/fig1_curves.png")
    args = parser.parse_args()
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), constrained_layout=True)
    for name, folder, style in (("mobile", args.mobile, "-"), ("stationary", args.stationary, "--")):
        if folder is None:
            continue
        rows = table(folder, args.every)
        path = ROOT / f"docs/results/fig1_{name}.csv"
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows({k: f"{v:.6g}" for k, v in row.items()} for row in rows)
        t = [r["time_s"] for r in rows]
        for key, colour in (("down", "tab:red"), ("side", "tab:green"), ("up", "tab:blue")):
            axes[0, 0].plot(t, [r[f"tip_{key}_um_s"] for r in rows], style, color=colour, label=f"{key}, {name}")
            axes[0, 1].plot(t, [r[f"arm_{key}_um"] for r in rows], style, color=colour)
        axes[1, 0].semilogy(t[1:], [r["max_speed_um_s"] for r in rows][1:], style, color="k", label=f"largest, {name}")
        if name == "mobile":
            axes[1, 1].plot(t, [r["settling_um_s"] for r in rows], color="k")
    for axis, label in zip(axes.flat, ("tip speed (µm/s)", "arm (µm)", "speed of the melt (µm/s)", "settling speed (µm/s)")):
        axis.set_xlabel("t (s)")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylim(0, 200)
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].legend(fontsize=8)
    figure.savefig(args.out, dpi=110)
    print(args.out)


if __name__ == "__main__":
    main()

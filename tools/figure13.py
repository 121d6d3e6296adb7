#!/usr/bin/python3
"""Solid fraction of twelve crystals that move, are held, or grow in melt at rest (figure 13 of Qi et al. 2017), and how the moving
ones fall, from runs of inputs/twelve_crystals.toml.

    figure13.py --mobile out/twelve_crystals [--held DIR] [--diffusion DIR] [--every 0.01]
                [--out docs/figures/twelve_curves.png] [--name twelve_crystals]

The held case is that input with flow.motion="held" flow.tolerance=1e-7, the other one without its table [flow]. Writes the
same numbers to docs/results/NAME.csv, and says whether grains.csv follows every crystal from the first line to the last.
"""
import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
CASES = (("mobile", "k-"), ("held", "tab:red"), ("diffusion", "tab:blue"))


def read(path):
    with open(path, encoding="utf-8") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file) if None not in row.values()]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for case, _ in CASES:
        parser.add_argument(f"--{case}", type=Path)
    parser.add_argument("--every", type=float, default=0.01)
    parser.add_argument("--out", type=Path, default=ROOT / "docs/figures/twelve_curves.png")
    parser.add_argument("--name", default="twelve_crystals")
    args = parser.parse_args()
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.5), constrained_layout=True)
    lines = {}
    for case, style in CASES:
        folder = getattr(args, case)
        if folder is None:
            continue
        rows = read(folder / "diagnostics.csv")
        axes[0].plot([r["time_s"] for r in rows], [r["solid_fraction"] for r in rows], style, label=case)
        for r in rows:
            if abs(r["time_s"] / args.every - round(r["time_s"] / args.every)) < 1e-6:
                line = lines.setdefault(round(r["time_s"], 9), {})
                line[f"solid_fraction_{case}"] = r["solid_fraction"]
                line[f"max_speed_um_s_{case}"] = r["max_speed_um_s"]
        drift = max(abs(r["solute_drift_rel"]) for r in rows)
        print(f"{case}: to {rows[-1]['time_s']:.4g} s, {int(rows[-1]['step'])} steps, solute drift {drift:.1e}")
        if case != "mobile":
            continue
        grains = {}
        for r in read(folder / "grains.csv"):
            grains.setdefault(int(r["grain"]), []).append(r)
        lengths = {len(g) for g in grains.values()}
        jumps = max(abs(b["y_um"] - a["y_um"]) for g in grains.values() for a, b in zip(g, g[1:]))
        print(f"{case}: {len(grains)} grains, {lengths} lines each; largest change of height between lines {jumps:.3g} um")
        for g, history in grains.items():
            axes[1].plot([r["time_s"] for r in history], [r["y_um"] for r in history], label=g)
            axes[2].plot([r["time_s"] for r in history], [-r["vy_um_s"] for r in history])
    for axis, label in zip(axes, ("solid fraction", "height of the crystals' centres (µm)", "settling speed (µm/s)")):
        axis.set_xlabel("t (s)")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(args.out, dpi=100)
    names = ["time_s", *(f"{what}_{case}" for case, _ in CASES for what in ("solid_fraction", "max_speed_um_s") if getattr(args, case))]
    with open(ROOT / f"docs/results/{args.name}.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, names, lineterminator="\n")
        table.writeheader()
        for t, line in sorted(lines.items()):
            table.writerow({"time_s": f"{t:.6g}"} | {k: f"{v:.6g}" for k, v in line.items()})
    print(args.out)


if __name__ == "__main__":
    main()

#!/usr/bin/python3
"""Strong or weak scaling from a folder of runs: a table (text, CSV) and a plot.

    scaling.py out/strong [--strong | --weak] [--from-step N] [--csv FILE] [--out PNG]

Every folder below with a manifest.json of a finished run counts; runs on the same number of ranks and threads give
a median and a spread. Times are differences of wall_s in diagnostics.csv, from its second line (the first after the
start, past the first plotfile) or from --from-step N to its last one: give runs a few lines, and no plotfiles or
checkpoints in between. Runs of equal cells and steps are taken as strong scaling, others as weak.

Speed-up is the number of cell updates a second over that of the fewest cores, efficiency that over the ratio of cores;
in strong scaling this is the ratio of the times, in weak scaling it allows for boxes that do not grow exactly. Shares
of phases are of the whole run less plotfiles and checkpoints.
"""
import argparse
import csv
import json
import statistics
import sys
from pathlib import Path

NESTED = ("ghost_fill", "ghost_wait")  # counted in other phases, too
FILES = ("plotfile", "checkpoint")  # left out of the shares: a short run spends most of its time on them


class InputError(Exception):
    """What is wrong, in one line."""


def read_lines(path):
    """Whole lines of diagnostics.csv: step, cells and wall_s."""
    if not path.is_file():
        raise InputError("no diagnostics.csv")
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        return [(int(row["step"]), int(row["cells"]), float(row["wall_s"])) for row in rows]
    except (KeyError, TypeError, ValueError):
        raise InputError("diagnostics.csv has lines without step, cells or wall_s") from None


def read_run(path, from_step):
    """One run as a dict; InputError says why it does not count."""
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        status, wall = manifest["status"], float(manifest["wall_s"])
        phases = {name: float(phase["seconds"]) for name, phase in manifest["wall_by_phase"].items()}
        stepping = max(wall - sum(phases.get(name, 0) for name in FILES), 1e-9)
        run = {"folder": path.parent, "ranks": int(manifest["ranks"]), "threads": int(manifest["threads"]),
               "build": (manifest.get("git_hash"), manifest.get("flags")),
               "machine": tuple(sorted(manifest.get("machine", {}).items())),
               "shares": {name: seconds / stepping for name, seconds in phases.items() if name not in FILES}}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"manifest.json cannot be read: {error!r}") from None
    if status != "done":
        raise InputError(f"status is {status}, not done")
    lines = read_lines(path.parent / "diagnostics.csv")
    walls = [wall for _, _, wall in lines]
    if any(a >= b for a, b in zip(walls, walls[1:])) or (walls and walls[-1] > 1.01 * wall):
        raise InputError("was restarted: the times of its parts cannot be told apart")
    if from_step is not None:
        lines = [line for line in lines if line[0] >= from_step]
        run["whole"] = False
    else:
        run["whole"] = len(lines) < 3
        lines = lines if run["whole"] else lines[1:]
    if len(lines) < 2:
        raise InputError("diagnostics.csv has fewer than two lines to take times from")
    steps, seconds = lines[-1][0] - lines[0][0], lines[-1][2] - lines[0][2]
    updates = sum((a[1] + b[1]) / 2 * (b[0] - a[0]) for a, b in zip(lines, lines[1:]))
    run.update(steps=steps, cells=updates / steps, seconds=seconds / steps, work=[line[:2] for line in lines],
               cores=run["ranks"] * run["threads"], rate=updates / seconds)
    return run


def read_runs(folder, from_step):
    runs, left_out = [], []
    for path in sorted(folder.rglob("manifest.json")):
        try:
            runs.append(read_run(path, from_step))
        except InputError as reason:
            left_out.append(f"{path.parent}: {reason}")
    return runs, left_out


def same_work(runs):
    return all(run["work"] == runs[0]["work"] for run in runs)


def table_of(runs):
    """A row for each number of ranks and threads, by cores."""
    groups = {}
    for run in runs:
        groups.setdefault((run["cores"], run["ranks"], run["threads"]), []).append(run)
    rows = []
    for (cores, ranks, threads), group in sorted(groups.items()):
        times, rates = [run["seconds"] for run in group], [run["rate"] for run in group]
        phases = sorted({name for run in group for name in run["shares"]})
        rows.append({"ranks": ranks, "threads": threads, "cores": cores, "runs": len(group),
                     "cells": statistics.median(run["cells"] for run in group),
                     "steps": statistics.median(run["steps"] for run in group),
                     "step_s": statistics.median(times), "step_min_s": min(times), "step_max_s": max(times),
                     "rates": (statistics.median(rates), min(rates), max(rates)),
                     "shares": {name: statistics.median(run["shares"].get(name, 0) for run in group)
                                for name in phases}})
    first = rows[0]
    for row in rows:
        speedup = [rate / first["rates"][0] for rate in row["rates"]]
        row["Mcell_per_s_core"] = row["rates"][0] / row["cores"] / 1e6
        row["speedup"], row["speedup_min"], row["speedup_max"] = speedup
        for end in ("", "_min", "_max"):
            row["efficiency" + end] = row["speedup" + end] * first["cores"] / row["cores"]
    return rows


COLUMNS = ["ranks", "threads", "cores", "runs", "cells", "steps", "step_s", "step_min_s", "step_max_s",
           "Mcell_per_s_core", "speedup", "efficiency", "efficiency_min", "efficiency_max"]


def phases_of(rows):
    """Names of phases, the longest first, those counted in others last."""
    names = {name for row in rows for name in row["shares"]}
    largest = {name: max(row["shares"].get(name, 0) for row in rows) for name in names}
    return sorted(names, key=lambda name: (name in NESTED, -largest[name]))


def write_csv(path, rows, kind):
    phases = phases_of(rows)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["kind", *COLUMNS, *(f"share_{name}" for name in phases)])
        for row in rows:
            numbers = [*(row[name] for name in COLUMNS), *(row["shares"].get(name, 0) for name in phases)]
            writer.writerow([kind, *(f"{value:.6g}" for value in numbers)])


def text_table(rows):
    phases = [name for name in phases_of(rows) if max(row["shares"].get(name, 0) for row in rows) >= 0.005]
    head = ["ranks", "threads", "runs", "cells", "steps", "s/step", "spread", "Mcell/s/core", "speed-up", "efficiency",
            *phases]
    lines = [head]
    for row in rows:
        spread = f"{100 * (row['step_max_s'] - row['step_min_s']) / row['step_s']:.0f} %" if row["runs"] > 1 else "-"
        lines.append([f"{row['ranks']}", f"{row['threads']}", f"{row['runs']}", f"{row['cells']:.0f}",
                      f"{row['steps']:.0f}", f"{row['step_s']:.4g}", spread, f"{row['Mcell_per_s_core']:.3g}",
                      f"{row['speedup']:.2f}", f"{100 * row['efficiency']:.0f} %",
                      *(f"{100 * row['shares'].get(name, 0):.0f} %" for name in phases)])
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in lines)


def plot(path, rows, kind):
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    plt.rcParams.update({"font.size": 8, "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
                         "lines.linewidth": 1.3, "axes.grid": True, "grid.color": "0.92", "grid.linewidth": 0.6})
    fig, ((time, speed), (efficiency, share)) = plt.subplots(2, 2, figsize=(8, 6), dpi=180, layout="constrained",
                                                             sharex=True)
    first, cores = rows[0], sorted({row["cores"] for row in rows})
    ratio = [n / first["cores"] for n in cores]
    ideal = {"color": "0.6", "ls": "--", "lw": 0.8, "label": "ideal"}
    time.plot(cores, [first["step_s"] / (r if kind == "strong" else 1) for r in ratio], **ideal)
    speed.plot(cores, ratio, **ideal)
    efficiency.axhline(1, **ideal)
    for number, threads in enumerate(sorted({row["threads"] for row in rows})):
        own = [row for row in rows if row["threads"] == threads]
        for ax, key, ends in ((time, "step_s", ("step_min_s", "step_max_s")),
                              (speed, "speedup", ("speedup_min", "speedup_max")),
                              (efficiency, "efficiency", ("efficiency_min", "efficiency_max"))):
            bars = [[abs(row[key] - row[end]) for row in own] for end in ends]
            ax.errorbar([row["cores"] for row in own], [row[key] for row in own], bars, marker="o", ms=3, capsize=2,
                        color=f"C{number}", label=f"{threads} thread{'s' if threads > 1 else ''} a rank")
    one_a_core = {row["cores"]: row for row in reversed(rows)}
    for number, name in enumerate(phases_of(rows)):
        values = [100 * one_a_core[n]["shares"].get(name, 0) for n in cores]
        if max(values) >= 0.5:
            share.plot(cores, values, marker="o", ms=3, color=f"C{number % 10}", ls=":" if name in NESTED else "-",
                       label=name)
    for ax, label in ((time, "time per step (s)"), (speed, "speed-up"), (efficiency, "efficiency"),
                      (share, "share of the time (%)")):
        ax.set_ylabel(label)
        ax.legend(fontsize=6, frameon=False)
        ax.set_xscale("log", base=2)
        ax.set_xticks(cores, [str(n) for n in cores])
    time.set_yscale("log")
    speed.set_yscale("log", base=2)
    for ax in (efficiency, share):
        ax.set_ylim(bottom=0)
        ax.set_xlabel("cores (ranks x threads)")
    fig.suptitle(f"{kind} scaling, {sum(row['runs'] for row in rows)} runs; bars: smallest to largest", fontsize=9)
    fig.savefig(path)
    plt.close(fig)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    def refuse(message):
        raise InputError(message)

    parser.error = refuse
    parser.add_argument("folder", metavar="DIR", type=Path)
    parser.add_argument("--strong", action="store_const", dest="kind", const="strong")
    parser.add_argument("--weak", action="store_const", dest="kind", const="weak")
    parser.add_argument("--from-step", type=int, metavar="N", help="take times from this step on")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="default: DIR/scaling.csv")
    parser.add_argument("--out", type=Path, metavar="PNG", help="default: DIR/scaling.png")
    opt = parser.parse_args()
    if not opt.folder.is_dir():
        raise InputError(f"{opt.folder}: no such folder")
    runs, left_out = read_runs(opt.folder, opt.from_step)
    for line in left_out:
        print(f"left out: {line}")
    if not runs:
        raise InputError(f"{opt.folder}: no finished run in it; " + (f"{len(left_out)} left out, see above" if left_out
                                                                    else "no manifest.json anywhere below"))
    kind = opt.kind or ("strong" if same_work(runs) else "weak")
    if kind == "strong" and not same_work(runs):
        other = next(run for run in runs if run["work"] != runs[0]["work"])
        raise InputError(f"strong scaling needs the same run on all ranks; cells or steps differ between "
                         f"{runs[0]['folder']} and {other['folder']}")
    for name in ("build", "machine"):
        if len({run[name] for run in runs}) > 1:
            print(f"note: runs of more than one {name}")
    if any(run["whole"] for run in runs):
        print("note: times from the first line on, with the first plotfile in them: only two lines in diagnostics.csv")
    rows = table_of(runs)
    if len(rows) == 1:
        print("note: one number of ranks and threads only: nothing to compare with")
    if kind == "weak":
        share = [row["cells"] / row["cores"] for row in rows]
        if max(share) > 1.1 * min(share):
            print(f"note: {min(share):.0f} to {max(share):.0f} cells a core; efficiency compares cell updates a second")
    print(f"{kind} scaling, {len(runs)} runs")
    print(text_table(rows))
    table, picture = opt.csv or opt.folder / "scaling.csv", opt.out or opt.folder / "scaling.png"
    try:
        write_csv(table, rows, kind)
        plot(picture, rows, kind)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write: {error}") from None
    print(table)
    print(picture)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as problem:
        print(f"scaling.py: {problem}", file=sys.stderr)
        sys.exit(2)

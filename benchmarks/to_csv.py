#!/usr/bin/env python3
"""to_csv.py RESULTS.json OUT.csv: the rows of dendrift-bench as a small table.

One line a benchmark: median, min and max of its speed in Mcell updates a second and core, and, for paired rows, the
median, min and max of the ratio of its time per update to that of the plain uniform loop. Rows on a tree say
how many cells the scene needs, and what one stage of them takes: cells / speed. Rows of solvers: microseconds a cell for
the whole solution.
"""
import csv
import json
import sys

COLUMNS = ["name", "median_Mcell_per_s", "min_Mcell_per_s", "max_Mcell_per_s", "plain_Mcell_per_s", "ratio",
           "ratio_min", "ratio_max", "cells", "blocks", "stages", "ms_per_stage", "interface_share", "ghost_time_share",
           "regrid_time_share", "us_per_cell", "us_min", "us_max", "iterations", "us_per_iteration", "residual",
           "hypre_us_per_cell", "hypre_iterations", "machine", "commit", "date"]


def rows(results):
    context = results["context"]
    where = {"machine": f"{context['processor']}, {context['compiler']}", "commit": context["commit"][:12],
             "date": context["date"][:10]}
    table = {}
    for b in results["benchmarks"]:
        row = table.setdefault(f"{context['dimensions']}d/{'/'.join(b['run_name'].split('/')[:2])}", dict(where))
        speed = b.get("Mcell_per_s")
        if b["run_type"] == "aggregate":
            name = b["aggregate_name"]
            if name in ("median", "min", "max"):
                row[f"{name}_Mcell_per_s"] = speed
            if name != "median":
                continue
        elif "us_per_cell" in b:  # a whole solution of equations
            row.update({k: b[k] for k in COLUMNS if k in b and k != "name"})
            continue
        elif "ratio" in b:  # a paired row: one repetition of many pairs
            row["median_Mcell_per_s"] = speed
        else:
            continue
        row.update({k: b[k] for k in COLUMNS if k in b and k != "name"})
        if "cells" in b:
            row["ms_per_stage"] = b["cells"] / speed / 1e3
    return [{"name": name, **row} for name, row in table.items()]


def main():
    source, target = sys.argv[1:]
    with open(source) as file:
        results = json.load(file)
    with open(target, "w", newline="") as file:
        out = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        out.writeheader()
        for row in rows(results):
            out.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})


if __name__ == "__main__":
    main()

#!/usr/bin/python3
"""tools/scaling.py: the figures of made-up runs, worked out by hand; what it leaves out and says; a real run."""
import csv
import json
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import SOURCE, require, run, say, scratch

SCENE = """
[run]
max_steps = 6
end_time_tau0 = 100
[mesh]
dim = 2
size_W0 = [64, 64]
[[seed]]
position_W0 = [32, 32]
radius_W0 = 6
[output]
diagnostics_every_tau0 = 0.05
"""


def scaling(*words, code=0):
    done = subprocess.run([sys.executable, SOURCE / "tools" / "scaling.py", *map(str, words)], capture_output=True,
                          text=True)
    require(done.returncode == code and "Traceback" not in done.stderr,
            f"scaling.py {words}: exit code {done.returncode}, {code} expected: {done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def made_up(folder, ranks, step_s, cells=1000, threads=1, status="done", flow=0.5, start=0.0):
    """A run of 100 steps of step_s after a first line and a first plotfile that took 7 s."""
    folder.mkdir(parents=True)
    wall = 7 + 100 * step_s + 2  # 2 s: the last plotfile
    (folder / "manifest.json").write_text(json.dumps({
        "git_hash": "abc", "flags": "", "machine": {"host": "a"}, "ranks": ranks, "threads": threads, "status": status,
        "exit_code": 0, "steps": 110, "wall_s": wall, "wall_by_phase": {
            "flow": {"seconds": flow * (wall - 9), "share": 0}, "plotfile": {"seconds": 9, "share": 0},
            "ghost_wait": {"seconds": 0.1 * (wall - 9), "share": 0}}}))
    lines = [f"{s},0,0,0,1,{cells},1,0,0,0,0,0,0,{w}" for s, w in
             ((0, 0.5), (10, 7 - start), (60, 7 + 50 * step_s), (110, 7 + 100 * step_s))]
    (folder / "diagnostics.csv").write_text("step,time_s,time_tau0,dt_tau0,blocks,cells,levels,solid_fraction,"
                                            "solute_mean_wt,solute_drift_rel,max_speed_um_s,div_max_rel,"
                                            "flow_iterations,wall_s\n" + "\n".join(lines) + "\n")


def rows_of(folder, name="scaling.csv"):
    with open(folder / name, newline="") as file:
        return [{key: value if key == "kind" else float(value) for key, value in row.items()}
                for row in csv.DictReader(file)]


def near(row, **expected):
    for name, value in expected.items():
        require(abs(row[name] - value) <= 1e-5 * abs(value), f"{name} = {value} expected: {row}")


def check_strong(folder):
    for number, step_s in enumerate((0.9, 1.0, 1.4)):
        made_up(folder / "ranks_1" / str(number), 1, step_s)
    made_up(folder / "ranks_4", 4, 0.5, flow=0.25)
    made_up(folder / "ranks_2", 1, 0.8, threads=2)
    text = scaling(folder)
    require("strong scaling, 5 runs" in text and "left out" not in text and "note" not in text, text)
    rows = rows_of(folder)
    require([(r["ranks"], r["threads"], r["runs"], r["kind"]) for r in rows] ==
            [(1, 1, 3, "strong"), (1, 2, 1, "strong"), (4, 1, 1, "strong")], f"rows {rows}")
    near(rows[0], step_s=1, step_min_s=0.9, step_max_s=1.4, steps=100, cells=1000, speedup=1, efficiency=1,
         efficiency_max=1 / 0.9, efficiency_min=1 / 1.4, Mcell_per_s_core=1e-3, share_flow=0.5, share_ghost_wait=0.1)
    near(rows[1], step_s=0.8, speedup=1.25, efficiency=0.625, cores=2)
    near(rows[2], step_s=0.5, speedup=2, efficiency=0.5, share_flow=0.25, Mcell_per_s_core=0.5e-3)
    require("share_plotfile" not in rows[0], f"plotfiles count: {rows[0]}")
    require((folder / "scaling.png").read_bytes()[:4] == b"\x89PNG", "no picture")
    scaling(folder, "--from-step", 60, "--csv", folder / "late.csv", "--out", folder / "late.png")
    near(rows_of(folder, "late.csv")[2], steps=50, step_s=0.5)
    scaling(folder, "--from-step", 110, code=2)
    say("strong scaling: median, spread, speed-up, efficiency, shares, --from-step")


def check_weak(folder):
    made_up(folder / "a", 1, 1.0, cells=1000)
    made_up(folder / "b", 4, 1.25, cells=4000)
    made_up(folder / "c", 8, 1.25, cells=12000)
    text = scaling(folder)
    require("weak scaling, 3 runs" in text and "1000 to 1500 cells a core" in text, text)
    rows = rows_of(folder)
    near(rows[1], speedup=3.2, efficiency=0.8, step_s=1.25)
    near(rows[2], speedup=9.6, efficiency=1.2)  # half as many cells again on each core, in 1.25 times the time
    text = scaling(folder, "--strong", code=2)
    require("needs the same run" in text, text)
    say("weak scaling: speed by cell updates, unequal shares are named")


def check_left_out(folder):
    require("no manifest.json" in scaling(folder, code=2), "an empty folder")
    require("no such folder" in scaling(folder / "nowhere", code=2), "a folder that is not there")
    made_up(folder / "running", 1, 1.0, status="running")
    made_up(folder / "restarted", 1, 1.0, start=6.9)
    made_up(folder / "no_lines", 1, 1.0)
    (folder / "no_lines/diagnostics.csv").unlink()
    made_up(folder / "short", 1, 1.0)
    (folder / "short/diagnostics.csv").write_text("step,cells,wall_s\n0,1,1\n")
    (folder / "torn").mkdir()
    (folder / "torn/manifest.json").write_text('{"ranks": ')
    text = scaling(folder, code=2)
    for words in ("running: status is running, not done", "restarted: was restarted", "no_lines: no diagnostics.csv",
                  "short: diagnostics.csv has fewer than two lines", "torn: manifest.json cannot be read",
                  "no finished run in it; 5 left out"):
        require(words in text, f"'{words}' expected: {text}")
    made_up(folder / "good", 2, 1.0)
    text = scaling(folder)
    require(text.count("left out: ") == 5 and "nothing to compare with" in text, text)
    say("runs that do not count: each with its reason")


def check_real(folder):
    (folder / "scene.toml").write_text(SCENE)
    for ranks in (1, 2):
        run("scene.toml", f"output.dir=runs/{ranks}", ranks=ranks, cwd=folder)
    text = scaling(folder / "runs")
    rows = rows_of(folder / "runs")
    require("strong scaling, 2 runs" in text and [r["ranks"] for r in rows] == [1, 2], text)
    require(all(r["step_s"] > 0 and 0 < r["share_solidification"] <= 1 for r in rows), f"{rows}")
    say("real runs on 1 and 2 ranks")


check_strong(scratch())
check_weak(scratch())
check_left_out(scratch())
check_real(scratch())

#!/usr/bin/python3
"""Runs the verification cases of docs/verification.md and writes their tables to docs/results/*.csv.

usage: tools/verify.py [--build DIR] [--ranks N] [--keep] CASE ...      (no CASE: list them; "all": every one)
Each case runs dendrift on an input of inputs/verification with overrides, and compares tips.csv and diagnostics.csv
with the reference numbers below. Lengths in W0, times in tau0 unless a column says otherwise.
"""
import argparse
import csv
import json
import math
import os
import subprocess
import sys
import tempfile

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
CASES = {}
ARGS = None


def case(f):
    CASES[f.__name__] = f
    return f


def dendrift(name, overrides, ranks=None, build=None):
    """Runs an input of inputs/verification; the folder of what it wrote."""
    folder = tempfile.mkdtemp(prefix="dendrift_verify_") if not ARGS.keep else os.path.join("out", "verify")
    out = os.path.join(folder, "run")
    command = ["mpirun", "--oversubscribe", "-n", str(ranks or ARGS.ranks), os.path.join(build or ARGS.build, "dendrift"),
               os.path.join(ROOT, "inputs", "verification", name), f"output.dir={out}", *overrides]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}\nended with {done.returncode}:\n{done.stdout[-2000:]}{done.stderr[-3000:]}")
    return out


class Run:
    """One run of dendrift; tips by arm and time, diagnostics by time."""

    def __init__(self, name, *overrides, ranks=None):
        self.dir = dendrift(name, overrides, ranks)
        check = subprocess.run([os.path.join(ARGS.build, "dendrift"), os.path.join(ROOT, "inputs", "verification", name),
                                *overrides, "run.max_steps=1", "--check"], capture_output=True, text=True).stdout
        self.scale = {line.split()[0]: float(line.split()[1]) for line in check.splitlines()
                      if line.split()[0] in ("W0", "tau0", "d0", "lambda", "D", "nu", "dx")}
        self.manifest = json.load(open(os.path.join(self.dir, "manifest.json")))
        self.wall = self.manifest["wall_s"]
        w0, tau0 = self.scale["W0"], self.scale["tau0"]
        self.diagnostics = list(csv.DictReader(open(os.path.join(self.dir, "diagnostics.csv"))))
        # Seconds and tau0 of the same lines: the exact ratio, not the six digits that --check prints.
        last = self.diagnostics[-1]
        if float(last["time_tau0"]) > 0:
            tau0 = float(last["time_s"]) / float(last["time_tau0"])
        self.tips = {}
        for row in csv.DictReader(open(os.path.join(self.dir, "tips.csv"))):
            t = round(float(row["time_s"]) / tau0, 6)
            x = [float(row[f"{a}_um"]) / w0 for a in "xyz" if f"{a}_um" in row]
            self.tips.setdefault(int(row["arm"]), {})[t] = (x, float(row["radius_um"]) / w0, float(row["off_axis_deg"]))
        self.drift = max(abs(float(d["solute_drift_rel"])) for d in self.diagnostics)
        self.cells = int(last["cells"])
        self.steps = int(last["step"])

    def length(self, arm, t, centre=(0, 0, 0)):
        return math.dist(self.tips[arm][t][0], centre[: len(self.tips[arm][t][0])])

    def speed(self, arm, t, h, centre=(0, 0, 0), drift=(0, 0, 0)):
        moved = [c + v * 2 * h for c, v in zip(centre, drift)]
        return (self.length(arm, t + h, moved) - self.length(arm, t - h, centre)) / (2 * h)


def percent(value, reference):
    return 100 * (value / reference - 1)


def write(name, rows):
    path = os.path.join(ROOT, "docs", "results", name + ".csv")
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w", newline="") as out:
        table = csv.DictWriter(out, rows[0].keys(), lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    print(f"\n{name}: {os.path.relpath(path, ROOT)}")
    for row in rows:
        print("  " + "  ".join(f"{k} {v:.6g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    sys.stdout.flush()


def box(dx, levels, dim=2, n=16, roots=1):
    side = roots * n * 2 ** (levels - 1) * dx
    return [f"mesh.size_W0=[{','.join([repr(side)] * dim)}]", f"mesh.root_blocks=[{','.join([str(roots)] * dim)}]",
            f"mesh.levels={levels}", f"mesh.block_cells={n}"]


@case
def growth():
    """Row 1: tip of the quarter crystal at t = 100 and 200, against spacing; cost; adaptive against uniform."""
    reference = {100: (21.56, 0.0751), 200: (28.18, 0.0599)}
    rows = []
    for dx, levels, kind in ((1.6, 7, "adaptive"), (1.25, 7, "adaptive"), (1.0, 7, "adaptive"), (0.8, 7, "adaptive"),
                             (0.625, 7, "adaptive"), (0.5, 8, "adaptive"), (0.4, 8, "adaptive"), (1.0, 7, "uniform")):
        if kind == "adaptive":
            mesh = box(dx, levels)
        else:
            mesh = box(dx, 1, roots=2 ** (levels - 1))
        r = Run("al_cu_free.toml", *mesh)
        row = {"mesh": kind, "dx_W0": dx}
        for t, (tip, v) in reference.items():
            row |= {f"tip_{t}": r.length(0, t), f"tip_{t}_err_percent": percent(r.length(0, t), tip),
                    f"V_{t}": r.speed(0, t, 5), f"V_{t}_err_percent": percent(r.speed(0, t, 5), v)}
        rows.append(row | {"steps": r.steps, "cells_at_end": r.cells, "wall_s": r.wall, "drift": r.drift})
    write("growth_2d", rows)


@case
def growth_dt():
    """Row 1 at dx = 1: error of the time step against the smallest one."""
    rows = []
    for dt in (0.03, 0.06, 0.12, 0.24, 0.3):
        r = Run("al_cu_free.toml", *box(1.0, 7), f"phase_field.max_dt_tau0={dt}")
        rows.append({"max_dt_tau0": dt, "tip_100": r.length(0, 100), "tip_200": r.length(0, 200), "steps": r.steps,
                     "wall_s": r.wall})
    for row in rows:
        row["tip_200_change_percent"] = percent(row["tip_200"], rows[0]["tip_200"])
    write("growth_2d_time_step", rows)


@case
def growth_3d():
    """Row 2: octant at t = 25 and 50."""
    reference = {25: (16.77, 0.199, 16213), 50: (21.37, 0.172, 28866)}
    rows = []
    for dx, roots, levels in ((1.25, 3, 3), (1.0, 4, 3), (0.8, 5, 3), (0.64, 5, 3)):
        r = Run("al_cu_free_3d.toml", *box(dx, levels, 3, roots=roots), "run.end_time_tau0=52.5")
        side = roots * 16 * 2 ** (levels - 1) * dx
        row = {"dx_W0": dx}
        for t, (tip, v, vol) in reference.items():
            solid = next(float(d["solid_fraction"]) for d in r.diagnostics if abs(float(d["time_tau0"]) - t) < 1e-6)
            row |= {f"tip_{t}": r.length(0, t), f"tip_{t}_err_percent": percent(r.length(0, t), tip),
                    f"V_{t}": r.speed(0, t, 2.5), f"V_{t}_err_percent": percent(r.speed(0, t, 2.5), v),
                    f"volume_{t}_err_percent": percent(8 * solid * side**3, vol)}
        rows.append(row | {"arms_differ": max(abs(r.length(a, 50) - r.length(0, 50)) for a in (2, 4)),
                           "cells_at_end": r.cells, "wall_s": r.wall, "drift": r.drift})
    write("growth_3d", rows)


KARMA = {1000: 0.0277, 2000: 0.0220, 4000: 0.0187, 5000: 0.0182, 8000: 0.0177, 9900: 0.0177}


def karma_row(program, ratio, dx, anisotropy, speed):
    """speed(t): V d0/D at t D/d0^2. The two last columns of the print's six times tell how far off the curve a run is."""
    row = {"program": program, "W0_over_d0": ratio, "dx_W0": dx, "anisotropy": anisotropy}
    row |= {f"V_{t}": speed(t) for t in KARMA}
    return row | {"largest_difference": max((row[f"V_{t}"] - v for t, v in KARMA.items()), key=abs), "c_s_over_c_l": ""}


@case
def karma():
    """Karma, Phys. Rev. Lett. 87, 115701 (2001), Figs. 1 and 2: dimensionless tip speed against time; and the same
    by five-point differences of phi, as published runs used, whose lattice lowers the anisotropy by (dx/W0)^2/240."""
    lowered = 0.02 - 0.4**2 / 240
    rows = []
    for ratio, dx, anisotropy in ((3.61, 1.0, 0.02), (3.61, 0.5, 0.02), (1.84, 1.0, 0.02), (1.84, 0.5, 0.02),
                                  (3.61, 1.0, lowered), (1.84, 1.0, lowered)):
        d = 0.6267 * 0.8839 * ratio
        unit = d * ratio**2  # t D/d0^2 in one tau0
        side = math.ceil(700 / ratio / 64) * 64
        r = Run("karma_2001.toml", f"alloy.W0_over_d0={ratio}", f"seed[0].radius_W0={22 / ratio}",
                f"mesh.size_W0=[{side},{side}]", f"mesh.dx_W0={dx}", f"run.end_time_tau0={10100 / unit}",
                f"phase_field.anisotropy={anisotropy}",
                f"output.diagnostics_every_tau0={100 / unit}", f"output.plot_every_tau0={10100 / unit}")
        times = sorted(r.tips[0])

        def speed(t):
            i = times.index(min(times, key=lambda x: abs(x * unit - t)))
            lo, hi = times[max(0, i - 2)], times[min(len(times) - 1, i + 2)]
            return (r.length(0, hi) - r.length(0, lo)) / (hi - lo) * ratio / unit
        rows.append(karma_row("dendrift", ratio, dx, anisotropy, speed))
        rows[-1]["c_s_over_c_l"] = axis_concentration(r, ratio)
    with tempfile.TemporaryDirectory() as folder:
        program = os.path.join(folder, "phi_form")
        subprocess.run(["g++", "-std=c++20", "-O3", "-march=native", "-ffast-math", "-o", program,
                        os.path.join(ROOT, "tools", "phi_form.cpp")], check=True)
        for points, dx in ((5, 0.8), (5, 0.4), (5, 0.2), (9, 0.4), (9, 0.2)):
            out = subprocess.run([program, str(dx), str(int(points == 9)), "3.61", ".55", ".15", ".02", "22", "460", "10200"],
                                 capture_output=True, text=True, check=True).stdout
            tip = {50 * i: float(line.split()[1]) for i, line in enumerate(out.splitlines())}
            rows.append(karma_row(f"phi, {points} points", 3.61, dx, 0.02,
                                  lambda t: (tip[t + 200] - tip[t - 200]) / 400))
    write("karma_2001", rows)


def axis_concentration(r, ratio):
    """Mean of c_s/c_l^0 on the arm's axis from 45 d0 behind the seed to 10 d0 behind the tip."""
    sys.path.insert(0, os.path.join(ROOT, "tools"))
    import plotfile
    import numpy as np
    last = sorted(f for f in os.listdir(r.dir) if f.startswith("plt_"))[-1]
    p = plotfile.Plotfile(os.path.join(r.dir, last))
    w0 = r.scale["W0"]
    tip = max(r.tips[0])
    end = r.length(0, tip) * w0
    x = np.linspace(60 / ratio * w0, end - 15 / ratio * w0, 200)
    y = 0.25 * r.scale["dx"] * w0
    values = np.array([p.sample_line("c", (xi, y), (xi, y), 1)[-1][0] for xi in x])
    c_l = 4.0 / (1 - (1 - 0.15) * 0.55)
    return float(np.mean(values) / c_l)


@case
def rotation():
    """A whole crystal turned by 0, 15, 30, 45 degrees: tips and direction of the arms at t = 200."""
    rows = []
    for dx in (1.0, 0.8):
        for angle in (0, 15, 30, 45):
            side = 512 * dx
            r = Run("al_cu_free.toml", *box(dx, 5, roots=2), f"seed[0].position_W0=[{side / 2},{side / 2}]",
                    f"seed[0].angle_deg={angle}")
            centre = (side / 2, side / 2)
            lengths = [r.length(a, 200, centre) for a in range(4)]
            rows.append({"dx_W0": dx, "angle_deg": angle, "tip_200": lengths[0],
                         "error_percent": percent(lengths[0], 28.18), "arms_differ": max(lengths) - min(lengths),
                         "off_axis_deg": max((r.tips[a][200][2] for a in range(4)), key=abs), "wall_s": r.wall})
        first = rows[-4]["tip_200"]
        for row in rows[-4:]:
            row["against_0_percent"] = percent(row["tip_200"], first)
    write("rotation", rows)


@case
def drift():
    """A crystal growing in a uniform drift against the same at rest, t = 100."""
    rows = []
    for dx in (1.0, 0.8):
        side = 256 * dx
        centre = (side / 2, side / 2)
        common = [*box(dx, 4, roots=2), f"seed[0].position_W0=[{centre[0]},{centre[1]}]"]
        rest = Run("crystal_in_drift.toml", *common, "flow.velocity_W0_tau0=[0,0]")
        for mode in ("material", "eulerian"):
            for v in (0.1, 0.5):
                r = Run("crystal_in_drift.toml", *common, f"flow.velocity_W0_tau0=[{v},0]", f'solute.antitrapping="{mode}"')
                row = {"dx_W0": dx, "antitrapping": mode, "drift": v}
                for name, arm in (("leading", 0), ("trailing", 1), ("lateral", 2)):
                    at = lambda t: (centre[0] + v * t, centre[1])
                    here, there = r.length(arm, 100, at(100)), rest.length(arm, 100, centre)
                    speed = (r.length(arm, 105, at(105)) - r.length(arm, 95, at(95))) / 10
                    row |= {f"{name}_difference_W0": here - there, f"{name}_percent": percent(here, there),
                            f"{name}_speed_percent": percent(speed, rest.speed(arm, 100, 5, centre))}
                    x, radius, lean = r.tips[2][100]
                length = r.length(2, 100, at(100))
                # The apex of the parabola: a leaning arm is longer than its section with the axis.
                row["lateral_lean_deg"] = lean
                row["lateral_apex_percent"] = percent(
                    length + (length * math.tan(math.radians(lean))) ** 2 / (2 * radius), rest.length(2, 100, centre))
                rows.append(row | {"solute_drift": r.drift, "wall_s": r.wall})
    write("drift", rows)


@case
def swimming():
    """A crystal that hardly grows (U = -.01), drift .5, t = 200: radii forward and backward."""
    rows = []
    side = 256
    for mode in ("material", "eulerian"):
        r = Run("crystal_hardly_growing.toml", f'solute.antitrapping="{mode}"')
        at = (side / 2 + 0.5 * 200, side / 2)
        rows.append({"antitrapping": mode, "forward": r.length(0, 200, at), "backward": r.length(1, 200, at)})
    write("swimming", rows)


@case
def carried():
    """A crystal that neither grows nor dissolves, carried 20 diameters across refined and coarse mesh."""
    rows = []
    for dx in (1.6, 1.0, 0.8, 0.5):
        roots = round(512 / (16 * 8 * dx))
        t = 800.0
        r = Run("crystal_carried.toml", *box(dx, 4, roots=roots))
        at = [64 + 0.4 * t, 64 + 0.3 * t]
        radii = [math.dist(r.tips[a][t][0], at) for a in range(4)]
        before, after = r.diagnostics[0], r.diagnostics[-1]
        extremes = composition(r)
        rows.append({"dx_W0": dx, "radius_min": min(radii), "radius_max": max(radii),
                     "area_change_percent": percent(float(after["solid_fraction"]), float(before["solid_fraction"])),
                     "U_min": extremes[0], "U_max": extremes[1], "U_rms_error": extremes[2], "solute_drift": r.drift,
                     "steps": r.steps, "wall_s": r.wall})
    write("carried", rows)


def composition(r):
    """Extremes of U and its rms deviation from -Omega where there is interface or solid (phi > -.9)."""
    sys.path.insert(0, os.path.join(ROOT, "tools"))
    import plotfile
    import numpy as np
    last = sorted(f for f in os.listdir(r.dir) if f.startswith("plt_"))[-1]
    p = plotfile.Plotfile(os.path.join(r.dir, last))
    u, phi = p.uniform("U")[0], p.uniform("phi")[0]
    return float(u.min()), float(u.max()), float(np.sqrt(np.mean((u[phi > -0.9] + 0.2) ** 2)))


@case
def disc():
    """A disc that settles in a closed box without inertia: velocity of its core over b/nu, and how rigid it is."""
    rows = []
    for dx, levels, roots in ((1.0, 1, 5), (0.5, 1, 10), (0.5, 2, 5), (0.25, 1, 20)):
        for law, ratio, reference in (("h3", 1e5, 13.99), ("h3", 1e6, ""), ("linear", 1e6, 3.296)):
            r = Run("disc_settling.toml", f"mesh.root_blocks=[{roots},{roots}]", f"mesh.levels={levels}",
                    f'flow.viscosity="{law}"', f"flow.viscosity_ratio={ratio}", "flow.tolerance=1e-8")
            last = list(csv.DictReader(open(os.path.join(r.dir, "grains.csv"))))[-1]
            b = 1e7 * r.scale["tau0"] ** 2 / r.scale["W0"] * (2.7 / 2.45 - 1)
            v = -float(last["vy_um_s"]) * r.scale["tau0"] / r.scale["W0"] / (b / r.scale["nu"])
            rows.append({"dx_W0": dx, "levels": levels, "law": law, "ratio": ratio, "speed": v, "reference": reference,
                         "error_percent": percent(v, reference) if reference else "", "nonrigidity": float(last["nonrigidity"]),
                         "iterations": max(int(d["flow_iterations"]) for d in r.diagnostics), "wall_s": r.wall})
    write("disc", rows)


class FlowRun:
    """One run of an input whose W0 is 1 um and tau0 1 s, so that the files are in W0 and tau0."""

    def __init__(self, name, *overrides, ranks=None, build=None):
        self.dir = dendrift(name, overrides, ranks, build)
        read = lambda file: [{k: float(v) for k, v in row.items()} for row in csv.DictReader(open(os.path.join(self.dir, file)))]
        self.diagnostics, self.grains = read("diagnostics.csv"), read("grains.csv")
        manifest = json.load(open(os.path.join(self.dir, "manifest.json")))
        self.commit = manifest["git_hash"][:7]
        self.wall, self.flow_s = manifest["wall_s"], manifest["wall_by_phase"]["flow"]["seconds"]
        self.iterations = int(max(d["flow_iterations"] for d in self.diagnostics))

    def plotfile(self):
        """The last one."""
        sys.path.insert(0, os.path.join(ROOT, "tools"))
        import plotfile
        return plotfile.Plotfile(os.path.join(self.dir, sorted(f for f in os.listdir(self.dir) if f.startswith("plt_"))[-1]))

    def velocity_within(self, centre, radius):
        """Mean velocity along the last axis within a distance of a place."""
        import numpy as np
        image, (x0, x1, y0, y1) = self.plotfile().uniform("velocity_y")
        y, x = np.indices(image.shape)
        dx = (x1 - x0) / image.shape[1]
        near = np.hypot(x0 + (x + 0.5) * dx - centre[0], y0 + (y + 0.5) * dx - centre[1]) < radius
        return float(image[near].mean())

    def drag(self, nu=1e9, weight=1e5):
        """F/(mu U) of the first crystal: its weight over nu and its velocity along the last axis."""
        g = [g for g in self.grains if g["grain"] == 0][-1]
        size, speed = (g["area_um2"], g["vy_um_s"]) if "area_um2" in g else (g["volume_um3"], g["vz_um_s"])
        return weight * size / (nu * -speed)

    def cost(self):
        return {"iterations": self.iterations, "wall_s": self.wall}


def flow_box(size, cells, levels=1, seed=None, n=16):
    """A box with so many cells along its sides on the finest level; seed: place and radius."""
    unit = n * 2 ** (levels - 1)
    assert all(c % unit == 0 for c in cells), cells
    words = [f"mesh.size_W0={[float(x) for x in size]}", f"mesh.root_blocks={[c // unit for c in cells]}", f"mesh.levels={levels}",
             f"mesh.block_cells={n}"]
    if seed:
        words += [f"seed[0].position_W0={[float(x) for x in seed[0]]}", f"seed[0].radius_W0={seed[1]!r}"]
    return words


@case
def disc_settling_closed():
    """A disc in a closed square box of side L against the sharp disc; offset: the sharp disc as fast is so much larger."""
    table = {8: 0.044211, 16: 0.093203}
    # 4 pi nu U/F = ln x - C + a/x^2, x = L/R, through both values of the table
    a = (4 * math.pi * (table[16] - table[8]) - math.log(2)) / (1 / 256 - 1 / 64)
    c = math.log(8) + a / 64 - 4 * math.pi * table[8]
    rows = []
    for ratio, radius, cells, levels in ((8, 10, 80, 1), (8, 10, 160, 1), (8, 20, 160, 1), (8, 40, 320, 1), (16, 10, 160, 1),
                                         (16, 20, 320, 1), (16, 20, 320, 3), (16, 40, 640, 3)):
        side = ratio * radius
        r = FlowRun("disc_settling_closed.toml", *flow_box([side] * 2, [cells] * 2, levels, ([side / 2] * 2, radius), n=16 if levels == 1 or cells > 320 else 8))
        u = 1 / r.drag()
        lo, hi = 0.5 * ratio, 2 * ratio
        for _ in range(60):
            x = 0.5 * (lo + hi)
            lo, hi = (x, hi) if math.log(x) - c + a / x**2 < 4 * math.pi * u else (lo, x)
        rows.append({"L_over_R": ratio, "R_W0": radius, "dx_W0": side / cells, "levels": levels, "U_nu_over_F": u,
                     "reference": table[ratio], "error_percent": percent(u, table[ratio]), "offset_W0": side / x - radius,
                     "nonrigidity": r.grains[-1]["nonrigidity"]} | r.cost())
    write("disc_settling_closed", rows)


@case
def offsets():
    """What a law of the viscosity adds to the radius of a settling disc (velocity of its middle, closed box of side 16 R)."""
    table = {8: 0.044211, 16: 0.093203}
    a = (4 * math.pi * (table[16] - table[8]) - math.log(2)) / (1 / 256 - 1 / 64)
    c = math.log(8) + a / 64 - 4 * math.pi * table[8]
    reference = {"linear": ((2.71, 6.26, 9.56), (2.60, 6.42, 9.69)), "h1": ((-0.27, -0.14, -0.14), (-0.51, -0.06, -0.05)),
                 "h2": ((-0.10, 0.02, 0.02), (-0.43, 0.00, 0.00)), "h3": ((-0.06, 0.06, 0.06), (-0.41, 0.01, 0.01))}
    rows = []
    for law, radii in reference.items():
        for radius, values in zip((10, 40), radii):
            for power, value in zip((2, 4, 6), values):
                side = 16 * radius
                # The linear law reaches 10 W0 into the melt, where the mesh would be coarse already: uniform, and dx = 1.
                cells, levels = (2 * side, 1) if radius == 10 else (side, 1) if law == "linear" else (2 * side, 3)
                r = FlowRun("disc_settling_closed.toml", *flow_box([side] * 2, [cells] * 2, levels, ([side / 2] * 2, radius)),
                            f'flow.viscosity="{law}"', f"flow.viscosity_ratio=1e{power}", "flow.tolerance=1e-7")
                v = r.velocity_within([side / 2] * 2, radius / 2)  # soft solids circulate: their middle is faster
                u = 1 / r.drag() * v / r.grains[-1]["vy_um_s"]
                lo, hi = 4, 32
                for _ in range(60):
                    x = 0.5 * (lo + hi)
                    lo, hi = (x, hi) if math.log(x) - c + a / x**2 < 4 * math.pi * u else (lo, x)
                rows.append({"law": law, "R_W0": radius, "ratio": f"1e{power}", "offset_W0": side / x - radius, "reference": value,
                             "nonrigidity": r.grains[-1]["nonrigidity"]} | r.cost())
    write("offsets", rows)


@case
def splitting():
    """Error of the velocity against the coupled solution with the same steps; nu dt/dx^2 = 1000, from rest."""
    methods = {"projection": ("projections=1", "rotational=false"), "projection, rotational": ("projections=1", "rotational=true"),
               "three projections, rotational": ("projections=3", "rotational=true"), "coupled, tolerance 1e-3": ("tolerance=1e-3",),
               "coupled, tolerance 1e-4": ("tolerance=1e-4",), "coupled, tolerance 1e-5": ("tolerance=1e-5",),
               "coupled, default tolerance": ("tolerance=2e-6",)}
    disc = flow_box([160, 160], [160, 160], 1, ([80, 80], 10)) + ["flow.gravity_um_s2=4000"]
    cross = ["flow.gravity_um_s2=10"]
    small = flow_box([256, 256], [256, 256], 3, ([128, 128], 31.6227766)) + ["seed[1].position_W0=[128,128]"]
    discs, crosses = "disc_settling_closed.toml", "cross_settling.toml"
    scenes = {"disc in its place": (discs, disc + ["flow.gravity_um_s2=0.4"]),
              "the same, box of 80": (discs, flow_box([80, 80], [80, 80], 1, ([40, 40], 10)) + ["flow.gravity_um_s2=0.4"]),
              "disc that falls .3 cells a step": (discs, disc + ["phase_field.rigid=true"]),
              "cross in its place, box of 768": (crosses, cross), "the same, box of 256": (crosses, small + cross),
              "cross that falls .3 cells a step, box of 256": (crosses, small + ["flow.gravity_um_s2=1e4", "phase_field.rigid=true"])}
    rows = []
    for scene, (name, words) in scenes.items():
        words = words + ["alloy.viscosity_um2_s=2e4", "flow.max_interval_tau0=0.05", "flow.max_change=10", "flow.courant=10",
                         "run.end_time_tau0=1.6", "output.diagnostics_every_tau0=0.05"]
        run = lambda *more: FlowRun(name, *words, *more)
        exact = run("flow.tolerance=1e-9")
        for method, keys in methods.items():
            coupling = "projection" if "projection" in method else "coupled"
            r = run(f'flow.coupling="{coupling}"', *[f"flow.{k}" for k in keys], *(["flow.tolerance=1e-7"] if coupling == "projection" else []))
            speed = lambda run, k: [g["vy_um_s"] for g in run.grains if g["grain"] == 0][k + 1]  # cross: two seeds
            error = lambda k: percent(speed(r, k), speed(exact, k))
            rows.append({"scene": scene, "method": method} | {f"error_percent_after_{k}": error(k) for k in (1, 3, 10, 30)}
                        | {"nonrigidity_after_10": [g["nonrigidity"] for g in r.grains if g["grain"] == 0][11],
                           "iterations_mean": sum(d["flow_iterations"] for d in r.diagnostics) / (len(r.diagnostics) - 1), "wall_s": r.wall})
    write("splitting", rows)


@case
def flow_steps():
    """Speed against error of the steps of the flow: the settling dendrite at .04 s, against fine steps and tolerance."""
    rows = []
    fine = ("flow.max_interval_tau0=0.5", "flow.max_change=0.005", "flow.courant=0.1", "flow.tolerance=1e-7")
    ways = {"reference": fine, "default": (), "tolerance 1e-4": ("flow.tolerance=1e-4",), "tolerance 1e-6": ("flow.tolerance=1e-6",),
            "max_change .02": ("flow.max_change=0.02",), "max_change .2": ("flow.max_change=0.2", "flow.max_interval_tau0=16"),
            "coarser by a level": ("flow.coarser_levels=1",),
            "courant 1": ("flow.courant=1",), "courant 2": ("flow.courant=2",),
            "projection": ('flow.coupling="projection"',), "three projections": ('flow.coupling="projection"', "flow.projections=3"),
            "projection, steps a tenth": ('flow.coupling="projection"', "flow.max_change=0.005", "flow.max_interval_tau0=0.4"),
            "penalised, tolerance 1e-7": ('flow.solid="penalised"', "flow.tolerance=1e-7")}
    for way, keys in ways.items():
        r = FlowRun("../settling_dendrite.toml", "run.end_time_s=0.04", "output.plot_every_s=0.04", *keys)
        g = r.grains[-1]
        exact = exact if rows else g
        rows.append({"way": way, "speed_um_s": -g["vy_um_s"], "error_percent": percent(g["vy_um_s"], exact["vy_um_s"]),
                     "fallen_error_percent": percent(g["y_um"] - r.grains[0]["y_um"], exact["y_um"] - r.grains[0]["y_um"]),
                     "flow_s": r.flow_s, "flow_over_rest": r.flow_s / (r.wall - r.flow_s), "wall_s": r.wall})
    write("flow_steps", rows)


@case
def kicks():
    """fig1_mobile for .02 s from --checkpoint: speed aside and spin of a crystal that should sink straight, at two tolerances."""
    if ARGS.checkpoint is None:
        print("kicks: needs --checkpoint FILE of inputs/paper/fig1_mobile.toml (output.keep_checkpoints=100 keeps them all)")
        return
    import h5py
    with h5py.File(ARGS.checkpoint) as file:
        begin = int(file.attrs["step"])
    rows = []
    for build, tolerance in ((ARGS.build, 2e-6), (ARGS.build, 1e-7)) + (((ARGS.other_build, 2e-6),) if ARGS.other_build else ()):
        r = FlowRun("../paper/fig1_mobile.toml", "--restart", ARGS.checkpoint, "--allow-changes", f"run.max_steps={begin + 820}",
                    "output.plot_every_s=1", "output.checkpoint_every_s=1", f"flow.tolerance={tolerance}", build=build)
        aside, spin = ([g[k] for g in r.grains] for k in ("vx_um_s", "omega_rad_s"))
        counts = [d["flow_iterations"] for d in r.diagnostics]
        rows.append({"program": r.commit, "tolerance": f"{tolerance:.0e}", "from_s": r.grains[0]["time_s"], "to_s": r.grains[-1]["time_s"],
                     "aside_least_um_s": min(aside), "aside_most_um_s": max(aside), "spin_least_rad_s": min(spin),
                     "spin_most_rad_s": max(spin), "iterations": sum(counts) / len(counts)})
    write("kicks", rows)


@case
def disc_linear():
    """The disc in a closed box with the printed, linear law of the viscosity."""
    rows = []
    for cells in (80, 160, 320):
        r = FlowRun("disc_linear.toml", *flow_box([80, 80], [cells] * 2))
        v = -r.grains[-1]["vy_um_s"] * 1e9 / 1e5
        rows.append({"dx_W0": 80 / cells, "velocity_over_b_nu": v, "reference": 3.296, "error_percent": percent(v, 3.296)} | r.cost())
    write("disc_linear", rows)


@case
def disc_in_shear():
    """Spin of a free disc, over half the vorticity, in boxes whose walls move with the shear flow; both stresses."""
    rows = []
    for shape, size, reference in (("square", (8, 8), 1.0), ("8R x 4R", (8, 4), 0.8311)):
        for radius, dx in ((20, 1), (40, 1), (20, 0.5)):
            side = [s * radius for s in size]
            r = FlowRun("disc_in_shear.toml", *flow_box(side, [round(s / dx) for s in side], 1, ([s / 2 for s in side], radius)))
            spin = -r.grains[-1]["omega_rad_s"] / 0.5e-3
            rows.append({"box": shape, "stress": "symmetric", "R_W0": radius, "dx_W0": dx, "spin": spin, "reference": reference,
                         "error_percent": percent(spin, reference)} | r.cost())
    r = FlowRun("disc_in_shear.toml", 'flow.stress="laplacian"')
    spin = -r.grains[-1]["omega_rad_s"] / 0.5e-3
    rows.append({"box": "square", "stress": "laplacian", "R_W0": 20, "dx_W0": 1, "spin": spin, "reference": 4e-6,
                 "error_percent": percent(spin, 4e-6)} | r.cost())
    write("disc_in_shear", rows)


@case
def rising():
    """A disc lighter than its melt against one heavier by as much (S1 of the paper's supplement)."""
    falling = FlowRun("rising_disc.toml", "flow.solid_density_ratio=1.5").grains[-1]
    rows = []
    for tolerance in ("1e-5", "1e-6", "1e-7"):
        g = FlowRun("rising_disc.toml", f"flow.tolerance={tolerance}")
        up = g.grains[-1]
        rows.append({"tolerance": tolerance, "rising": up["vy_um_s"], "falling": falling["vy_um_s"],
                     "difference_percent": percent(up["vy_um_s"], -falling["vy_um_s"]), "sideways_over_V": abs(up["vx_um_s"] / up["vy_um_s"])} | g.cost())
    write("rising", rows)


@case
def turned():
    """A dendrite that grows while everything turns (S2): arms of equal length, tips as fast as those of one at rest."""
    rows = []
    for dx in (1.0, 0.8):
        mesh = [f"mesh.dx_W0={dx}"]
        still = Run("turned_dendrite.toml", *mesh, "flow.velocity_gradient_per_tau0=[0,0,0,0]")
        moving = Run("turned_dendrite.toml", *mesh)
        centre = (384, 384)
        lengths = [moving.length(arm, 200, centre) for arm in range(4)]
        rest = still.length(0, 200, centre)
        speed = lambda r: (r.length(0, 200, centre) - r.length(0, 180, centre)) / 20
        radius = lambda r: r.tips[0][200][1]
        rows.append({"dx_W0": dx, "arms_differ_percent": 100 * (max(lengths) / min(lengths) - 1), "length_percent": percent(lengths[0], rest),
                     "speed_percent": percent(speed(moving), speed(still)), "radius_percent": percent(radius(moving), radius(still)),
                     "drift": moving.drift, "wall_s": moving.wall})
    write("turned", rows)


@case
def sheared():
    """A dendrite in forced shear (S3): its spin over gamma/2, in the mean from 100 tau0 to the end; the literal model beside it."""
    rows = []
    literal = ('flow.stress="laplacian"', 'flow.viscosity="linear"', 'solute.antitrapping="eulerian"')
    for model, keys in (("as it is", ()), ("as it is, flow coarser by a level", ("flow.coarser_levels=1",)),
                        ("as it is, tolerance a tenth", ("flow.tolerance=1e-6",)), ("literal", literal)):
        r = Run("dendrite_in_shear.toml", *keys)
        grains = list(csv.DictReader(open(os.path.join(r.dir, "grains.csv"))))
        late = [g for g in grains if float(g["time_s"]) / r.scale["tau0"] > 99]
        turned = float(late[-1]["angle_rad"]) - float(late[0]["angle_rad"])
        time = (float(late[-1]["time_s"]) - float(late[0]["time_s"])) / r.scale["tau0"]
        spins = [-float(g["omega_rad_s"]) * r.scale["tau0"] / 1e-3 for g in late]
        rows.append({"model": model, "spin": -turned / time / 1e-3, "least": min(spins), "most": max(spins),
                     "turned_deg": math.degrees(float(late[-1]["angle_rad"])), "nonrigidity": float(late[-1]["nonrigidity"]), "wall_s": r.wall})
    write("sheared", rows)


CHANNEL = {0.1: (8.951, 0.4972), 0.2: (16.533, 0.4887), 0.3: (29.16, 0.4737), 0.5: (99.4, 0.4196)}


def channel(width_over_d, radius):
    """Width of the channel, cells across it and levels."""
    width = 2 * radius / width_over_d
    cells = round(width / 32) * 32
    return width, cells


@case
def disc_between_walls():
    """Drag of a disc that settles in the middle of a channel whose closed ends are two widths away."""
    rows = []
    for ratio, (reference, _) in CHANNEL.items():
        for radius in (16, 32) if ratio > 0.15 else (12.8,):
            width, cells = channel(ratio, radius)
            levels = 2
            r = FlowRun("disc_between_walls.toml", *flow_box([width, 4 * width], [cells, 4 * cells], levels, ([width / 2, 2 * width], radius)))
            rows.append({"d_over_W": ratio, "R_W0": radius, "dx_W0": width / cells, "drag": r.drag(), "reference": reference,
                         "error_percent": percent(r.drag(), reference)} | r.cost())
    write("disc_between_walls", rows)


@case
def disc_in_couette():
    """Spin of a free disc in the middle of a channel with walls that move against each other."""
    rows = []
    for ratio, (_, reference) in CHANNEL.items():
        for radius in (16, 32) if ratio > 0.15 else (12.8,):
            width, cells = channel(ratio, radius)
            r = FlowRun("disc_in_couette.toml", *flow_box([4 * width, width], [4 * cells, cells], 2, ([2 * width, width / 2], radius)))
            spin = -r.grains[-1]["omega_rad_s"] / 1e-3
            rows.append({"d_over_W": ratio, "R_W0": radius, "dx_W0": width / cells, "spin": spin, "reference": reference,
                         "error_percent": percent(spin, reference)} | r.cost())
    write("disc_in_couette", rows)


@case
def disc_in_drum():
    """Drag of a disc that sinks in the middle of a drum that is held, R/a = 2.5."""
    rows = []
    for radius, side, cells in ((16, 96, 96), (16, 96, 192), (32, 192, 192)):
        r = FlowRun("disc_in_drum.toml", *flow_box([side] * 2, [cells] * 2, 1, ([side / 2] * 2, radius)), f"seed[1].position_W0={[side / 2] * 2}",
                    f"seed[1].radius_W0={5 * radius}", f"seed[1].inner_radius_W0={2.5 * radius}")
        reference = 4 * math.pi / (math.log(2.5) - 5.25 / 7.25)
        rows.append({"a_W0": radius, "dx_W0": side / cells, "drag": r.drag(), "reference": reference,
                     "error_percent": percent(r.drag(), reference)} | r.cost())
    write("disc_in_drum", rows)


@case
def cylinder_array():
    """Drag of a square array of cylinders, Sangani & Acrivos (1982)."""
    rows = []
    for fraction, reference in ((0.05, 15.56), (0.1, 24.83), (0.2, 51.53), (0.3, 102.9), (0.4, 217.9), (0.5, 532.6)):
        for cells in (128, 256):
            radius = cells * math.sqrt(fraction / math.pi)
            r = FlowRun("cylinder_array.toml", *flow_box([cells] * 2, [cells] * 2, 1, ([cells / 2] * 2, radius)))
            rows.append({"fraction": fraction, "R_W0": radius, "drag": r.drag(), "reference": reference,
                         "error_percent": percent(r.drag(), reference)} | r.cost())
    write("cylinder_array", rows)


@case
def sphere_array():
    """Drag of a simple cubic array of spheres over 6 pi mu a U, Zick & Homsy (1982)."""
    rows = []
    for fraction, reference in ((0.027, 2.008), (0.064, 2.810), (0.125, 4.292), (0.216, 7.442)):
        for side, dx in ((32, 1), (32, 0.5), (64, 1), (96, 1)):
            radius = side * (0.75 * fraction / math.pi) ** (1 / 3)
            r = FlowRun("sphere_array.toml", *flow_box([side] * 3, [round(side / dx)] * 3, 1, ([side / 2] * 3, radius)))
            drag = r.drag() / (6 * math.pi * radius)
            rows.append({"fraction": fraction, "R_W0": radius, "dx_W0": dx, "drag": drag, "reference": reference,
                         "error_percent": percent(drag, reference)} | r.cost())
    write("sphere_array", rows)


@case
def ellipse_in_shear():
    """Half a turn of an ellipse of aspect ratio 2 in shear flow, against Jeffery's for an unbounded melt."""
    rows = []
    radius = 16.970563
    for side, levels, tolerance in ((256, 4, 1e-9), (512, 5, 1e-9), (512, 5, 1e-8), (1024, 6, 1e-9)):
        r = FlowRun("ellipse_in_shear.toml", *flow_box([side] * 2, [side] * 2, levels, ([side / 2] * 2, radius)), f"flow.tolerance={tolerance}")
        half = None
        for a, b in zip(r.grains, r.grains[1:]):
            if a["angle_rad"] > -math.pi >= b["angle_rad"]:
                half = a["time_s"] + (b["time_s"] - a["time_s"]) * (a["angle_rad"] + math.pi) / (a["angle_rad"] - b["angle_rad"])
        period = 2 * half * 0.05 if half else float("nan")
        spins = [-g["omega_rad_s"] / 0.05 for g in r.grains[2:]]
        rows.append({"side_over_long_axis": side / (2 * radius * math.sqrt(2)), "R_W0": radius, "tolerance": tolerance, "T_gamma": period,
                     "reference": 15.708, "error_percent": percent(period, 15.708), "slowest_spin": min(spins), "reference_slowest": 0.2,
                     "fastest_spin": max(spins), "reference_fastest": 0.8} | r.cost())
    write("ellipse_in_shear", rows)


@case
def falling_disc():
    """Terminal Reynolds number rho_s V d/mu of the disc of Glowinski, Wan & Turek: 17.15 to 17.45."""
    rows = []
    for radius, weight in ((10, "of phi"), (10, "sharp"), (20, "of phi"), (20, "sharp")):
        scale = radius / 10
        nu = scale  # so that the velocity in W0/tau0 is the same
        g = 0.19160156 * nu**2 / scale**3
        if weight == "sharp":  # the tanh profile adds pi^3/6 W0^2 to the disc
            g *= radius**2 / (radius**2 + math.pi**2 / 6)
        r = FlowRun("falling_disc.toml", *flow_box([160 * scale, 480 * scale], [round(160 * scale), round(480 * scale)], 2 if scale == 1 else 3,
                                                   ([80 * scale, 320 * scale], radius)),
                    f"flow.gravity_um_s2={g!r}", f"alloy.viscosity_um2_s={nu}", f"run.end_time_tau0={400 * scale}",
                    f"output.diagnostics_every_tau0={5 * scale}")
        v = max(-x["vy_um_s"] for x in r.grains)
        re = 1.25 * v * 2 * radius / nu
        rows.append({"R_W0": radius, "weight": weight, "Re": re, "reference_low": 17.15, "reference_high": 17.45,
                     "still_rising_percent": percent(v, -r.grains[-11]["vy_um_s"]), "sideways_over_V": max(abs(x["vx_um_s"]) for x in r.grains) / v,
                     "area_change_percent": percent(r.grains[-1]["area_um2"], r.grains[1]["area_um2"])} | r.cost())
    write("falling_disc", rows)


@case
def drafting():
    """Two discs that fall one behind the other (Feng, Hu & Joseph 1994): the one behind catches up, they touch, and change over."""
    rows = []
    for solid in ("viscous", "penalised"):
        r = FlowRun("drafting_discs.toml", f"flow.solid={solid}")
        behind, ahead = (sorted((g for g in r.grains if g["grain"] == n), key=lambda g: g["time_s"]) for n in (0, 1))
        nu, d = 0.6, 16
        seen = []  # time, gap, slope of the line of centres to gravity, mean speed of both
        for b, a in zip(behind, ahead):
            dx, dy = b["x_um"] - a["x_um"], b["y_um"] - a["y_um"]
            seen.append((b["time_s"], math.hypot(dx, dy) - d, math.degrees(math.atan2(abs(dx), dy)), -(a["vy_um_s"] + b["vy_um_s"]) / 2))
        least = min(seen, key=lambda row: row[1])
        met = next((row for row in seen if row[1] < 2), None)
        over = next((row for row in seen if row[2] > 90), None)
        rows.append({"solid": solid, "Re": max(row[3] for row in seen) * d / nu, "behind_over_ahead_at_meeting":
                     next((b["vy_um_s"] / a["vy_um_s"] for b, a in zip(behind, ahead) if met and b["time_s"] >= met[0] - 20), ""),
                     "kiss_s": met[0] / 106.67 if met else "", "least_gap_W0": least[1], "change_over_s": over[0] / 106.67 if over else "",
                     "angle_at_end_deg": seen[-1][2], "gap_at_end_W0": seen[-1][1],
                     "shortest_step_tau0": min(x["dt_tau0"] for x in r.diagnostics[1:])} | r.cost())
    write("drafting", rows)


GHIA = {  # place, velocity along the lid (x = 1/2) at Re 100 and 1000; place, velocity across it (y = 1/2)
    "u": ((0.0547, -0.03717, -0.18109), (0.0625, -0.04192, -0.20196), (0.0703, -0.04775, -0.22220), (0.1016, -0.06434, -0.29730),
          (0.1719, -0.10150, -0.38289), (0.2813, -0.15662, -0.27805), (0.4531, -0.21090, -0.10648), (0.5, -0.20581, -0.06080),
          (0.6172, -0.13641, 0.05702), (0.7344, 0.00332, 0.18719), (0.8516, 0.23151, 0.33304), (0.9531, 0.68717, 0.46604),
          (0.9609, 0.73722, 0.51117), (0.9688, 0.78871, 0.57492), (0.9766, 0.84123, 0.65928)),
    "v": ((0.0625, 0.09233, 0.27485), (0.0703, 0.10091, 0.29012), (0.0781, 0.10890, 0.30353), (0.0938, 0.12317, 0.32627),
          (0.1563, 0.16077, 0.37095), (0.2266, 0.17507, 0.33075), (0.2344, 0.17527, 0.32235), (0.5, 0.05454, 0.02526),
          (0.8047, -0.24533, -0.31966), (0.8594, -0.22445, -0.42665), (0.9063, -0.16914, -0.51550), (0.9453, -0.10313, -0.39188),
          (0.9531, -0.08864, -0.33714), (0.9609, -0.07391, -0.27669), (0.9688, -0.05906, -0.21388)),
}


@case
def cavity():
    """Lid-driven cavity at Re 100 and 1000: velocities on the centre lines against Ghia, Ghia & Shin (1982)."""
    import numpy as np
    rows, lines = [], []
    for re, cells, times in ((100, 32, 20), (100, 64, 20), (1000, 64, 60), (1000, 128, 60)):
        r = FlowRun("cavity.toml", *flow_box([cells] * 2, [cells] * 2), f"alloy.viscosity_um2_s={cells / re}", f"run.end_time_tau0={times * cells}",
                    f"output.diagnostics_every_tau0={times * cells / 20}")
        p = r.plotfile()
        x, y = p.uniform("velocity_x")[0], p.uniform("velocity_y")[0]
        middle = {"u": (x[:, cells // 2 - 1] + x[:, cells // 2]) / 2, "v": (y[cells // 2 - 1] + y[cells // 2]) / 2}
        row = {"Re": re, "cells": cells}
        for name, line in middle.items():
            off = []
            for place, at_100, at_1000 in GHIA[name]:
                s = place * cells - 0.5
                i = min(max(int(s) - 1, 0), cells - 4)  # cubic through four cells
                value = sum(line[i + a] * math.prod((s - i - b) / (a - b) for b in range(4) if b != a) for a in range(4))
                reference = at_100 if re == 100 else at_1000
                off.append(float(value) - reference)
                lines.append({"Re": re, "cells": cells, "line": name, "place": place, "velocity": float(value), "reference": reference})
            for kind, best in (("min", np.argmin), ("max", np.argmax)):  # of a parabola through three cells
                if name == "u" and kind == "max":
                    continue  # at the lid
                i = int(np.clip(best(line), 1, cells - 2))
                a, b, c = (float(v) for v in line[i - 1 : i + 2])
                row[f"{name}_{kind}"] = b - (c - a) ** 2 / (8 * (a - 2 * b + c))
            row |= {f"{name}_largest_difference": max(off, key=abs), f"{name}_rms_difference": float(np.sqrt(np.mean(np.square(off))))}
        rows.append(row | r.cost())
    write("cavity_lines", lines)
    write("cavity", rows)


@case
def taylor_green():
    """Vortices that decay while all drifts: error of the velocity at dx and dx/2, time step with dx^2."""
    import numpy as np
    rows = []
    side, u, drift, nu = 64.0, 0.1, (0.2, 0.1), 0.5
    k, end = 2 * math.pi / side, 40.0
    for cells, dt in ((32, 0.8), (64, 0.2), (128, 0.05)):
        r = FlowRun("taylor_green.toml", *flow_box([side] * 2, [cells] * 2), f"flow.initial_velocity_W0_tau0={list(drift)}",
                    f"run.end_time_tau0={end}", f"phase_field.max_dt_tau0={dt}", f"flow.max_interval_tau0={dt}",
                    "flow.tolerance=1e-9")  # thousands of solutions follow one another
        p = r.plotfile()
        t, h = end - dt, side / cells  # the flow is that of the beginning of the last step
        x = (np.arange(cells) + 0.5) * h
        fx, fy = np.meshgrid(k * (x - drift[0] * t), k * (x - drift[1] * t))
        # of the mean over a face, and of two faces: what the start and the file hold
        amplitude = u * math.exp(-2 * nu * k * k * t) * math.sin(k * h / 2) / (k * h / 2) * math.cos(k * h / 2)
        off = np.hypot(p.uniform("velocity_x")[0] - drift[0] - amplitude * np.sin(fx) * np.cos(fy),
                       p.uniform("velocity_y")[0] - drift[1] + amplitude * np.cos(fx) * np.sin(fy))
        rows.append({"cells": cells, "dt_tau0": dt, "rms_error_percent": 100 * float(np.sqrt(np.mean(off**2))) / (u * math.exp(-2 * nu * k * k * t) / math.sqrt(2)),
                     "order": ""} | r.cost())
        if len(rows) > 1:
            rows[-1]["order"] = math.log2(rows[-2]["rms_error_percent"] / rows[-1]["rms_error_percent"])
    write("taylor_green", rows)


@case
def width():
    """W0/d0 = 5 ... 30 at the same physical seed and time (.05 s)."""
    rows = []
    base = None
    for ratio in (5, 10, 15, 20, 30):
        for dx in (1.0, 0.8):
            d0 = 0.0214357
            w0 = ratio * d0
            r = Run("interface_width.toml", f"alloy.W0_over_d0={ratio}", f"seed[0].radius_W0={100 / ratio}", *box(dx, 7 if ratio >= 10 else 8))
            last = max(r.tips[0])
            tip = r.length(0, last) * w0
            rows.append({"W0_over_d0": ratio, "dx_W0": dx, "tip_um": tip, "steps": r.steps, "cells_at_end": r.cells,
                         "wall_s": r.wall})
    finest = next(row["tip_um"] for row in rows if row["W0_over_d0"] == 5 and row["dx_W0"] == 0.8)
    for row in rows:
        row["against_5_percent"] = percent(row["tip_um"], finest)
    write("width", rows)


def main():
    global ARGS
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE")
    parser.add_argument("--build", default=os.path.join(ROOT, "build", "release"))
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--checkpoint", metavar="FILE", help="where kicks begins")
    parser.add_argument("--other-build", metavar="DIR", help="kicks: a build of another commit beside this one")
    parser.add_argument("--keep", action="store_true", help="leave the last run in out/verify")
    ARGS = parser.parse_args()
    if not ARGS.cases:
        for name, f in CASES.items():
            print(f"{name:12s} {f.__doc__}")
        return
    for name in CASES if ARGS.cases == ["all"] else ARGS.cases:
        if name not in CASES:
            parser.error(f"no case {name}; there are {', '.join(CASES)}")
        CASES[name]()


if __name__ == "__main__":
    main()

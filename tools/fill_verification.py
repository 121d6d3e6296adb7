#!/usr/bin/python3
"""Writes the tables of docs/results into docs/verification.md: between the header of a table that follows a line
`tools/verify.py CASE` and the next blank line, rows are replaced by those of the CSV file."""
import csv
import os
import re

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def rows(name):
    with open(os.path.join(ROOT, "docs", "results", name + ".csv")) as f:
        return list(csv.DictReader(f))


def num(text, digits):
    return f"{float(text):.{digits}f}"


def growth(r):
    return [r["mesh"], r["dx_W0"], num(r["tip_100"], 3), num(r["tip_100_err_percent"], 2) + " %", num(r["tip_200"], 3),
            num(r["tip_200_err_percent"], 2) + " %", num(r["V_200"], 5), num(r["V_200_err_percent"], 2) + " %"]


def growth_dt(r):
    return [r["max_dt_tau0"], num(r["tip_200"], 4), num(r["tip_200_change_percent"], 4) + " %"]


def growth_3d(r):
    return [r["dx_W0"], num(r["tip_25"], 3), num(r["tip_25_err_percent"], 2) + " %",
            num(r["volume_25_err_percent"], 2) + " %", num(r["tip_50"], 3), num(r["tip_50_err_percent"], 2) + " %",
            num(r["volume_50_err_percent"], 2) + " %"]


def rotation(r):
    return [r["dx_W0"], r["angle_deg"], num(r["tip_200"], 3), num(r["error_percent"], 2) + " %",
            num(r["against_0_percent"], 2) + " %", num(r["off_axis_deg"], 4)]


def drift(r):
    return [r["dx_W0"], r["antitrapping"], r["drift"], *(num(r[k + "_percent"], 3) + " %" for k in
            ("leading", "trailing", "lateral", "leading_speed", "trailing_speed")),
            num(r["lateral_lean_deg"], 2) + " deg", num(r["lateral_apex_percent"], 2) + " %"]


def carried(r):
    return [r["dx_W0"], num(r["radius_min"], 3) + " to " + num(r["radius_max"], 3),
            num(r["area_change_percent"], 2) + " %", num(r["U_rms_error"], 4), num(r["U_min"], 4) + ", " + num(r["U_max"], 4)]


def disc(r):
    return [r["dx_W0"], r["levels"], r["law"], f"{float(r['ratio']):.0e}", num(r["speed"], 3),
            num(r["error_percent"], 2) + " %" if r["error_percent"] else "", r["iterations"]]


def disc_settling_closed(r):
    return [r["L_over_R"], r["R_W0"], r["dx_W0"], r["levels"], num(r["U_nu_over_F"], 5), num(r["error_percent"], 2) + " %", num(r["offset_W0"], 3)]


def against(*keys, digits=3):
    return lambda r: [*(num(r[k], 1) if "." in r[k] and k == "R_W0" else r[k] for k in keys[:-1]), num(r[keys[-1]], digits), r["reference"],
                      num(r["error_percent"], 2) + " %"]


def ellipse_in_shear(r):
    return [num(r["side_over_long_axis"], 2), r["tolerance"], num(r["T_gamma"], 3), r["reference"], num(r["error_percent"], 2) + " %",
            num(r["slowest_spin"], 4), num(r["fastest_spin"], 4)]


def falling_disc(r):
    return [r["R_W0"], r["weight"], num(r["Re"], 2), num(r["still_rising_percent"], 2) + " %", num(r["area_change_percent"], 3) + " %"]


def cavity(r):
    return [r["Re"], r["cells"], *(num(r[f"{a}_{b}_difference"], 4) for a in "uv" for b in ("largest", "rms")),
            *(num(r[k], 4) for k in ("u_min", "v_max", "v_min"))]


def taylor_green(r):
    return [r["cells"], r["dt_tau0"], num(r["rms_error_percent"], 3) + " %", num(r["order"], 2) if r["order"] else ""]


def splitting(r):
    return [r["scene"], r["method"], *(f"{float(r[f'error_percent_after_{k}']):.2g} %" for k in (1, 3, 10, 30)),
            f"{float(r['nonrigidity_after_10']):.1e}", num(r["iterations_mean"], 1)]


def flow_steps(r):
    return [r["way"], num(r["error_percent"], 3) + " %", num(r["fallen_error_percent"], 3) + " %", num(r["flow_over_rest"], 2)]


def kicks(r):
    return [r["program"], r["tolerance"], *(num(r[f"aside_{k}_um_s"], 3) for k in ("least", "most")),
            *(num(r[f"spin_{k}_rad_s"], 4) for k in ("least", "most")), num(r["iterations"], 1)]


def width_rows():
    table = rows("width")
    base = next(float(r["tip_um"]) for r in table if r["W0_over_d0"] == "10" and r["dx_W0"] == "0.8")
    return [[r["W0_over_d0"], r["dx_W0"], num(r["tip_um"], 4), f"{100 * (float(r['tip_um']) / base - 1):.2f} %",
             r["steps"], r["cells_at_end"], r["wall_s"]] for r in table]


def karma_rows():
    return [[r["program"], r["W0_over_d0"], r["dx_W0"], num(r["anisotropy"], 4)[1:],
             *(num(r[f"V_{t}"], 4)[1:] for t in (1000, 2000, 4000, 5000, 8000, 9900)),
             num(r["c_s_over_c_l"], 3)[1:] if r["c_s_over_c_l"] else ""] for r in rows("karma_2001")]


TABLES = {
    "growth": lambda: map(growth, rows("growth_2d")), "growth_dt": lambda: map(growth_dt, rows("growth_2d_time_step")),
    "growth_3d": lambda: map(growth_3d, rows("growth_3d")), "rotation": lambda: map(rotation, rows("rotation")),
    "drift": lambda: map(drift, rows("drift")), "carried": lambda: map(carried, rows("carried")), "disc": lambda: map(disc, rows("disc")),
    "disc_settling_closed": lambda: map(disc_settling_closed, rows("disc_settling_closed")),
    "disc_linear": lambda: map(against("dx_W0", "velocity_over_b_nu"), rows("disc_linear")),
    "disc_in_shear": lambda: map(lambda r: [r["box"], r["stress"], r["R_W0"], r["dx_W0"], f"{float(r['spin']):.4g}", r["reference"],
                                            num(r["error_percent"], 2) + " %"], rows("disc_in_shear")),
    "disc_between_walls": lambda: map(against("d_over_W", "R_W0", "drag"), rows("disc_between_walls")),
    "disc_in_couette": lambda: map(against("d_over_W", "R_W0", "spin", digits=4), rows("disc_in_couette")),
    "cylinder_array": lambda: map(against("fraction", "R_W0", "drag", digits=2), rows("cylinder_array")),
    "sphere_array": lambda: map(against("fraction", "R_W0", "dx_W0", "drag"), rows("sphere_array")),
    "ellipse_in_shear": lambda: map(ellipse_in_shear, rows("ellipse_in_shear")),
    "falling_disc": lambda: map(falling_disc, rows("falling_disc")), "cavity": lambda: map(cavity, rows("cavity")),
    "taylor_green": lambda: map(taylor_green, rows("taylor_green")),
    "offsets": lambda: map(lambda r: [r["law"], r["R_W0"], r["ratio"], num(r["offset_W0"], 3), r["reference"],
                                      f"{float(r['nonrigidity']):.1e}"], rows("offsets")),
    "splitting": lambda: map(splitting, rows("splitting")), "flow_steps": lambda: map(flow_steps, rows("flow_steps")),
    "kicks": lambda: map(kicks, rows("kicks")),
    "rising": lambda: map(lambda r: [r["tolerance"], num(r["rising"], 7), num(r["falling"], 7), num(r["difference_percent"], 4) + " %"], rows("rising")),
    "turned": lambda: map(lambda r: [r["dx_W0"], *(num(r[k + "_percent"], 3) + " %" for k in ("arms_differ", "length", "speed", "radius")),
                                     f"{float(r['drift']):.0e}"], rows("turned")),
    "sheared": lambda: map(lambda r: [r["model"], *(f"{float(r[k]):.4g}" for k in ("spin", "least", "most")), num(r["turned_deg"], 2)],
                           rows("sheared")),
    "width": width_rows, "karma": karma_rows,
}


def main():
    path = os.path.join(ROOT, "docs", "verification.md")
    lines, out, case, in_table = open(path).read().split("\n"), [], None, False
    for line in lines:
        found = re.match(r"`tools/verify.py (\w+)`", line)
        if found:
            case = found.group(1)
        if in_table and not line.startswith("| print"):
            if line.startswith("|") or line.startswith("@"):
                continue
            in_table = False
        out.append(line)
        if line.startswith("| ---") and case in TABLES:
            in_table = True
            table = ["| " + " | ".join(r) + " |" for r in TABLES[case]()]
            if case != "karma":
                out += table
                case = None  # later tables, with no command of their own, are written by hand
        if in_table and line.startswith("| print"):
            out += table
    open(path, "w").write("\n".join(out))


if __name__ == "__main__":
    main()

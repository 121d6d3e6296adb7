#!/usr/bin/python3
"""Pictures and films of Dendrift plotfiles.

    plot.py out/plt_0000123.hdf                       phi and c, the interface, the blocks
    plot.py out --field c,speed --arrows              the last plotfile of a folder
    plot.py out --field phi,c --film growth.mp4       all plotfiles, one colour range a field
"""
import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.collections import LineCollection  # noqa: E402
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap, Normalize  # noqa: E402
from matplotlib.ticker import MaxNLocator  # noqa: E402

from plotfile import Plotfile, PlotfileError, find_plotfiles  # noqa: E402

DPI = 200
# kind: how the colour range is found, and whether cells may be averaged and interpolated.
#   plain   min to max              phase   -1 to 1                       label   whole numbers, cell by cell
#   signed  symmetric about 0       angle   modulo 90 degrees, in the solid only, cell by cell
#   liquid  min to max of the liquid, solid grey: its far lower values would leave one colour to the melt
STYLES = {
    "phi": (r"$\varphi$", "phase", "phase"), "U": (r"$U$", "plasma", "plain"),
    "c": (r"$c$ (wt%)", "viridis", "liquid"), "alpha": (r"$\alpha$ (deg)", "turn", "angle"),
    "pressure": (r"$p$", "RdBu_r", "signed"), "speed": (r"$|v|$ (µm/s)", "flow", "plain"),
    "level": ("level", "Blues", "label"), "rank": ("rank", "tab20", "label"), "grain": ("grain", "tab10", "label"),
    **{f"velocity_{a}": (rf"$v_{a}$ (µm/s)", "RdBu_r", "signed") for a in "xyz"},
}
# phase: pale melt to slate solid, neither end so dark that the contour drowns; flow: white where nothing
# moves; turn: cyclic and nowhere dark.
OWN_MAPS = {
    "phase": ["#f4f7fa", "#d3e0ec", "#9bb7d2", "#5f86ae", "#3c5f8a"],
    "flow": ["#f7fbfa", "#bfe3d3", "#63bcb0", "#3a85a4", "#41528f", "#33214f"],
    "turn": ["#d98880", "#d9ad5b", "#93b865", "#52b3a0", "#6a9fd0", "#a98cca", "#d98880"],
}


def colour_map(name):  # a copy either way: matplotlib.colormaps hands out copies
    return LinearSegmentedColormap.from_list(name, OWN_MAPS[name]) if name in OWN_MAPS else matplotlib.colormaps[name]


def style(field):
    return STYLES.get(field, (field, "viridis", "plain"))


# ---- reading --------------------------------------------------------------------------------------------


def paint(plot, field, opt):
    """The field on the picture's uniform array and its extent; `speed` is made from the velocities."""
    if field not in plot.cache:  # panel, contour and mask often want the same field
        plot.cache[field] = paint_new(plot, field, opt)
    return plot.cache[field]


def paint_new(plot, field, opt):
    place = {"axis": opt.axis, "position": opt.position, "box": opt.zoom,
             "level": plot.level_for(opt.pixels, opt.axis, opt.zoom, beyond=0 if opt.cells else 4)}
    if field == "speed" and "speed" not in plot.fields:
        parts = [paint(plot, f"velocity_{a}", opt) for a in "xyz"[:plot.dim]]
        return np.sqrt(sum(image**2 for image, _ in parts)), parts[0][1]
    kind = style(field)[2]
    exact = kind in ("angle", "label")
    image, extent = plot.uniform(field, mean=not exact, smooth=not (exact or opt.cells), **place)
    if kind == "angle":
        image = np.degrees(np.mod(image, np.pi / 2))  # four-fold crystals: equal modulo a quarter turn
    if (kind == "angle" or field == "grain") and "phi" in plot.fields:
        image = np.where(paint(plot, "phi", opt)[0] > 0, image, np.nan)  # means nothing in the melt
    return image, extent


def find_range(plot, field, opt):
    """Lowest and highest colour value of a field in one file."""
    kind = style(field)[2]
    if field in opt.fixed or kind in ("angle", "phase"):
        return opt.fixed.get(field, (0.0, 90.0) if kind == "angle" else (-1.0, 1.0))
    image = paint(plot, field, opt)[0]
    if kind == "liquid" and "phi" in plot.fields:
        melt = image[paint(plot, "phi", opt)[0] < -0.99]
        image = melt if melt.size else image
    image = image[np.isfinite(image)]
    lo, hi = (float(image.min()), float(image.max())) if image.size else (0.0, 0.0)
    return (-max(-lo, hi), max(-lo, hi)) if kind == "signed" else (0.0 if field == "speed" else lo, hi)


def find_ranges(path, opt):
    with Plotfile(path) as plot:
        return [find_range(plot, field, opt) for field in opt.field]


def block_lines(plot, opt, per_um):
    """[(level, is_cells, segments)]: each edge once, by the coarser of its two blocks (both equal: by one).

    Edges between blocks too small to see are left out; the border of a refined region is always drawn.
    """
    h, v = plot.plane_axes(opt.axis)
    window = plot.window(opt.axis, opt.zoom)
    out = []
    for level in plot.levels:
        blocks, _ = plot.cut(level, opt.axis, opt.position)
        size = level.n * level.dx
        corner = plot.origin[[h, v]] + level.lo[blocks][:, [h, v]] * level.dx
        near = ((corner < [window[1], window[3]]) & (corner + size > [window[0], window[2]])).all(axis=1)
        number = level.lo[blocks][:, [h, v]] // max(1, level.n)
        leaf = level.is_leaf[blocks]
        keys = number[:, 0] * (1 << 30) + number[:, 1]
        segments = []
        for step, (a, b) in {(-1, 0): ((0, 0), (0, 1)), (1, 0): ((1, 0), (1, 1)),
                             (0, -1): ((0, 0), (1, 0)), (0, 1): ((0, 1), (1, 1))}.items():
            other = keys + step[0] * (1 << 30) + step[1]
            edge = np.isin(other, keys[~leaf])  # the neighbour is refined: the border of a finer region
            if sum(step) < 0 and size * per_um >= 8:
                edge |= np.isin(other, keys[leaf])
            at = corner[edge & leaf & near]
            segments.append(np.stack([at + np.multiply(a, size), at + np.multiply(b, size)], axis=1))
        out.append((level.index, False, np.concatenate(segments)))
        if opt.cells and level.dx * per_um >= 4:
            at, along = corner[leaf & near][:, None], np.arange(1, level.n)[:, None] * level.dx
            for e, f in (((1, 0), (0, 1)), ((0, 1), (1, 0))):
                first = at + along * e
                out.append((level.index, True, np.stack([first, first + np.multiply(f, size)], 2).reshape(-1, 2, 2)))
    return out


# ---- drawing --------------------------------------------------------------------------------------------


def layout(ratio, panels, width_px):
    """Figure size and axes boxes in inches; ratio = height/width of a panel. One row unless more win clearly."""
    left, bar, top, bottom = 0.62, 0.80, 0.44, 0.50

    def width(columns):  # of a panel in a picture no wider than 1900 pixels and no taller than 1500
        return min((9.5 - left) / columns - bar, ((7.5 - top) / -(-panels // columns) - bottom) / ratio, 6)

    full = [columns for columns in range(1, panels) if panels % columns == 0 and width(columns) > 1.3 * width(panels)]
    columns = max(full, key=width, default=panels)
    w = (width_px / DPI - left) / columns - bar if width_px else width(columns)
    w, rows = max(w, 0.4), panels // columns
    h = w * ratio
    size = max(left + columns * (w + bar), 3.4), top + rows * (h + bottom)  # room for the title
    return size, [(left + i % columns * (w + bar), size[1] - top - h - i // columns * (h + bottom), w, h)
                  for i in range(panels)]


def draw_panel(fig, ax, bar_ax, plot, field, limits, opt, lines):
    image, extent = paint(plot, field, opt)
    label, cmap, kind = style(field)
    cmap, (lo, hi) = colour_map(opt.cmap or cmap), limits
    if kind == "label":
        lo, hi = int(round(lo)), int(round(hi))
        count = hi - lo + 1
        if count > 20:
            cmap, norm, ticks = colour_map(opt.cmap or "turbo"), Normalize(lo, hi), MaxNLocator(6, integer=True)
        else:  # a colour each: from a list of colours in turn, from a gradient in equal steps
            cmap = colour_map("tab20") if cmap.N == 10 < count else cmap
            cmap = ListedColormap(cmap(np.arange(count) % cmap.N if cmap.N <= 20 else np.linspace(0.15, 0.8, count)))
            norm, ticks = BoundaryNorm(np.arange(lo, hi + 2) - 0.5, count), range(lo, hi + 1)
    else:
        if hi - lo <= 1e-9 * max(abs(lo), abs(hi)):  # a constant field gets a bar too, and its round-off no colours
            lo, hi = (0, 1) if field == "speed" else (lo - 0.5 * max(abs(lo), 1), hi + 0.5 * max(abs(hi), 1))
        norm = Normalize(lo, hi)
        ticks = range(0, 91, 15) if (kind, lo, hi) == ("angle", 0, 90) else MaxNLocator(6, steps=[1, 2, 2.5, 5, 10])
    cmap.set_bad("#c4c8ce" if kind == "liquid" else "white")
    if kind == "liquid" and field not in opt.fixed and "phi" in plot.fields:
        image = np.where(paint(plot, "phi", opt)[0] > 0, np.nan, image)
    smooth = "nearest" if kind in ("angle", "label") else "antialiased"
    shown = ax.imshow(image, origin="lower", extent=extent, cmap=cmap, norm=norm, interpolation=smooth)
    slack = 0.01 * (hi - lo)
    low, high = np.nanmin(image, initial=np.inf) < lo - slack, np.nanmax(image, initial=-np.inf) > hi + slack
    extend = "neither" if kind == "label" else ("neither", "min", "max", "both")[low + 2 * high]
    bar = fig.colorbar(shown, cax=bar_ax, extend=extend, extendfrac=0.03, ticks=ticks)
    bar.ax.tick_params(labelsize=7, length=2, width=0.5)
    bar.ax.minorticks_off()
    bar.outline.set_linewidth(0.5)
    bar.ax.set_title(label, fontsize=8, loc="left", pad=5)
    rgb = cmap(norm(np.ma.masked_invalid(image[::8, ::8])))[..., :3]
    light = (rgb @ [0.30, 0.59, 0.11]).mean() > 0.55
    for level, is_cells, segments in lines:  # finer levels thinner and fainter, or they bury the picture
        fade = 0.75 ** (level + (2 if is_cells else 0))
        ax.add_collection(LineCollection(segments, colors="0.25" if light else "1.0", linewidths=0.15 + 0.35 * fade,
                                         alpha=(0.12 + 0.33 * fade), capstyle="butt"))
    for name, values in opt.contour:
        data, interface = paint(plot, name, opt)[0], name == "phi" and values == [0.0]
        if style(name)[2] == "liquid" and "phi" in plot.fields:  # or they all crowd in the interface
            data = np.where(paint(plot, "phi", opt)[0] > -0.9, np.nan, data)
        if min(data.shape) > 1 and np.nanmin(data) <= max(values) and np.nanmax(data) >= min(values):
            x, y = (a + (np.arange(m) + 0.5) * (b - a) / m for a, b, m in
                    zip(extent[::2], extent[1::2], data.shape[::-1]))
            ax.contour(x, y, data, levels=values, colors="#10131a" if interface or light else "white",
                       linewidths=0.7 if interface else 0.45, linestyles="solid")
    if opt.arrows:
        draw_arrows(ax, plot, opt, "#10131a" if light else "white")
    ax.set(xlim=extent[:2], ylim=extent[2:])
    ax.tick_params(labelsize=7, length=2.5, width=0.5, direction="out")
    ax.spines[:].set_linewidth(0.5)


def draw_arrows(ax, plot, opt, colour):
    """Velocity in the plane of the picture, about 22 arrows along the longer side."""
    x0, x1, y0, y1 = plot.window(opt.axis, opt.zoom)
    step = max(x1 - x0, y1 - y0) / 22
    x, y = (np.arange(a + step / 2, b, step) for a, b in ((x0, x1), (y0, y1)))
    h, v = plot.plane_axes(opt.axis)
    points = np.full((y.size, x.size, plot.dim), 0 if plot.dim == 2 else plot.plane(opt.axis, opt.position))
    points[..., h], points[..., v] = np.meshgrid(x, y)
    u, w = (plot.sample(f"velocity_{'xyz'[d]}", points.reshape(-1, plot.dim))[0] for d in (h, v))
    top = np.hypot(u, w).max()
    if top > 0:
        ax.quiver(*np.meshgrid(x, y), u, w, angles="xy", scale_units="xy", scale=top / (1.6 * step), width=0.0028,
                  headwidth=4.5, headlength=5, minlength=0.4, color=colour, alpha=0.85, linewidth=0)


def draw(path, out, opt, ranges=None):
    """One plotfile to one PNG; without ranges the colours span what this file holds."""
    with Plotfile(path) as plot:
        ranges = ranges or [find_range(plot, field, opt) for field in opt.field]
        x0, x1, y0, y1 = plot.window(opt.axis, opt.zoom)
        size, boxes = layout((y1 - y0) / (x1 - x0), len(opt.field), opt.width)
        lines = block_lines(plot, opt, boxes[0][2] * DPI / (x1 - x0)) if opt.mesh or opt.cells else []
        if opt.cells and not any(is_cells for _, is_cells, _ in lines):
            print("cells are too small to draw here: --zoom in", file=sys.stderr)
        fig = plt.figure(figsize=size, dpi=DPI)

        def inches(x, y, w, h):
            return x / size[0], y / size[1], w / size[0], h / size[1]

        names = ["xyz"[a] for a in plot.plane_axes(opt.axis)]
        for field, limits, (x, y, w, h) in zip(opt.field, ranges, boxes):
            ax = fig.add_axes(inches(x, y, w, h))
            bar_ax = fig.add_axes(inches(x + w + 0.08, y, 0.09, h - 0.18))
            draw_panel(fig, ax, bar_ax, plot, field, limits, opt, lines)
            ax.set_xlabel(f"{names[0]} (µm)", fontsize=8, labelpad=2)
            if x == boxes[0][0]:
                ax.set_ylabel(f"{names[1]} (µm)", fontsize=8, labelpad=3)
            else:
                ax.set_yticklabels([])
        time = f"{plot.time_s:.4f}" if plot.time_s >= 1e-3 or plot.time_s == 0 else f"{plot.time_s:.3e}"
        where = "" if plot.dim == 2 else f"   {opt.axis} = {plot.plane(opt.axis, opt.position):.4g} µm"
        y = 1 - 0.14 / size[1]
        title = fig.text(boxes[0][0] / size[0], y, f"t = {time} s{where}", fontsize=9, weight="bold", va="top")
        end = title.get_window_extent(fig.canvas.get_renderer()).x1 / DPI + 0.15
        fig.text(end / size[0], y, f"{plot.blocks:,} blocks · {plot.cells:,} cells".replace(",", "\u2009"),
                 fontsize=8, color="0.35", va="top")
        try:
            fig.savefig(out, dpi=DPI)
        except ValueError as error:  # an ending that matplotlib does not know
            raise PlotfileError(f"{out}: {error}") from None
        plt.close(fig)
    return out


def film(files, out, opt):
    """All plotfiles to one film, one colour range a field; says what made it."""
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(opt.jobs) as pool:
        ranges = [(min(r[0] for r in field), max(r[1] for r in field))
                  for field in zip(*pool.map(partial(find_ranges, opt=opt), files))]
        names = [f"{folder}/{i:06d}.png" for i in range(len(files))]
        for i, _ in enumerate(pool.map(partial(draw, opt=opt, ranges=ranges), files, names), 1):
            if sys.stderr.isatty():
                print(f"\r{i} of {len(files)} frames", end="" if i < len(files) else "\n", file=sys.stderr, flush=True)
        if out.suffix == ".mp4" and not shutil.which("ffmpeg"):
            out = out.with_suffix(".gif")
            print("ffmpeg is not installed: writing a gif instead")
        if out.suffix == ".mp4":  # the encoder wants even sides
            done = subprocess.run(
                ["ffmpeg", "-y", "-loglevel", "error", "-framerate", str(opt.fps), "-i", f"{folder}/%06d.png",
                 "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-c:v", "libx264", "-crf", "18",
                 "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(out)],
                capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
            if done.returncode:
                raise PlotfileError(f"ffmpeg could not write {out}: {(done.stderr.strip().splitlines() or ['?'])[-1]}")
        else:
            from PIL import Image
            frames = [Image.open(name).convert("RGB") for name in names]
            # One palette from the last frame, the fullest: a palette a frame makes still areas flicker.
            palette = frames[-1].quantize(255)
            frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
            frames[0].save(out, save_all=True, append_images=frames[1:], duration=round(1000 / opt.fps), loop=0)
    print(f"{out}: {len(files)} frames, written by {'ffmpeg' if out.suffix == '.mp4' else 'pillow'}")


# ---- command line ---------------------------------------------------------------------------------------


def numbers(text, count, option):
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise PlotfileError(f"{option}: expected {count} numbers with commas between, found '{text}'")
    return values


def contour_of(text):
    """FIELD=v1,v2,... or FIELD=first:last:step"""
    name, _, values = text.partition("=")
    if values.count(":") == 2:
        first, last, step = numbers(values.replace(":", ","), 3, "--contour")
        if step <= 0 or last < first or (last - first) / step > 1000:
            raise PlotfileError(f"--contour: expected first <= last and a positive step, found '{text}'")
        return name, [first + step * i for i in range(int((last - first) / step + 1e-6) + 1)]
    return name, sorted(numbers(values, values.count(",") + 1, "--contour"))


def parse(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: (_ for _ in ()).throw(PlotfileError(message))
    add = parser.add_argument
    add("path", metavar="FILE_OR_DIR", help="a plotfile, or a folder: its last plotfile, or with --film all of them")
    add("--field", help="fields with commas between, a panel each; `speed` is |velocity| (default phi,c)")
    add("--mesh", action=argparse.BooleanOptionalAction, default=True, help="outlines of the blocks")
    add("--cells", action="store_true", help="cells too, where they are large enough to see")
    add("--contour", action="append", default=[], metavar="FIELD=V,..",
        help="isolines, also FIELD=first:last:step; may be repeated; phi=0 is always drawn unless `none` is given")
    add("--arrows", action="store_true", help="velocity arrows")
    add("--slice", metavar="AXIS=UM", help="3D: the plane to show (default z, through the middle)")
    add("--zoom", metavar="X0,X1,Y0,Y1", help="window, um")
    add("--range", action="append", default=[], metavar="[FIELD=]LO,HI", help="ends of the colour bar, in its unit")
    add("--cmap", help="a matplotlib colour map in place of each field's own")
    add("--width", type=int, metavar="PX", help="width of the picture")
    add("--out", type=Path, metavar="PNG", help="default: the plotfile's name with .png")
    add("--film", type=Path, metavar="MP4_OR_GIF", help="a film of all plt_*.hdf of the folder")
    add("--fps", type=float, default=10, help="frames a second (default 10)")
    add("--jobs", type=int, default=min(8, os.cpu_count() or 1), help="processes that draw a film's frames")
    # A value such as -5,5 would be taken for an option: --zoom -5,5 becomes --zoom=-5,5.
    joined = re.sub(r"(--range|--zoom)\0(?=-[\d.])", r"\1=", "\0".join(argv))
    opt = parser.parse_args(joined.split("\0") if joined else [])

    opt.axis, opt.position = "z", None
    if opt.slice:
        opt.axis, _, position = opt.slice.partition("=")
        if opt.axis not in ("x", "y", "z"):
            raise PlotfileError(f"--slice: expected x=, y= or z= and a position in um, found '{opt.slice}'")
        opt.position = numbers(position, 1, "--slice")[0] if position else None
    opt.zoom = numbers(opt.zoom, 4, "--zoom") if opt.zoom else None
    if opt.zoom and (opt.zoom[0] >= opt.zoom[1] or opt.zoom[2] >= opt.zoom[3]):
        raise PlotfileError("--zoom: expected x0 < x1 and y0 < y1")
    if opt.cmap and opt.cmap not in matplotlib.colormaps:
        raise PlotfileError(f"--cmap: matplotlib has no colour map '{opt.cmap}'")
    if (opt.width is not None and not 200 <= opt.width <= 20000) or opt.fps <= 0 or opt.jobs < 1:
        raise PlotfileError("expected --width of 200 to 20000, --fps above 0, --jobs of 1 or more")
    if opt.film and opt.film.suffix not in (".mp4", ".gif"):
        raise PlotfileError(f"--film: expected a name ending in .mp4 or .gif, found '{opt.film}'")
    return opt


def main():
    opt = parse(sys.argv[1:])
    path = Path(opt.path)
    if opt.film and not path.is_dir():
        raise PlotfileError(f"--film: expected a folder with plotfiles, found '{path}'")
    files = find_plotfiles(path) if path.is_dir() else [path]
    files = files if opt.film else files[-1:]

    with Plotfile(files[-1]) as plot:  # refuse what cannot be drawn before drawing anything
        present = set(plot.fields) | ({"speed"} if "velocity_x" in plot.fields else set())
        opt.field = opt.field.split(",") if opt.field else [f for f in ("phi", "c") if f in present] or plot.fields[:1]
        wanted = [contour_of(text) for text in opt.contour if text != "none"]
        if "none" not in opt.contour and "phi" in present:
            wanted.append(("phi", [0.0]))
        opt.contour = wanted
        for name in opt.field + [name for name, _ in wanted] + ["speed"] * opt.arrows:
            if name not in present:
                raise PlotfileError(f"{plot.path}: no field '{name}'; it has {', '.join(plot.fields)}")
        if opt.slice and plot.dim == 2:
            raise PlotfileError(f"{plot.path}: is 2D, so --slice has nothing to cut")
        plot.window(opt.axis, opt.zoom)
        if plot.dim == 3:
            plot.plane(opt.axis, opt.position)
    opt.pixels = max(1500, (opt.width or 0) / len(opt.field))

    opt.fixed = {}
    for text in opt.range:
        name, equals, values = text.rpartition("=")
        lo, hi = numbers(values, 2, "--range")
        if lo >= hi or (equals and name not in opt.field):
            raise PlotfileError(f"--range: expected LO < HI for a field that is drawn, found '{text}'")
        opt.fixed.update(dict.fromkeys([name] if equals else opt.field, (lo, hi)))

    if opt.film:
        film(files, opt.film, opt)
    else:
        print(draw(files[0], opt.out or files[0].with_suffix(".png"), opt))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (PlotfileError, OSError) as problem:
        print(f"plot.py: {problem}", file=sys.stderr)
        sys.exit(2)

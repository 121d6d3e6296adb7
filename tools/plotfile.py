#!/usr/bin/python3
"""Reader of Dendrift plotfiles (Chombo data with a VTKHDF face, every block of the tree in the file).

    from plotfile import Plotfile
    with Plotfile("out/plt_0000123.hdf") as p:
        print(p.time_s, p.step, p.fields, p.blocks, p.cells, p.integral("c"), p.max("phi"))
        image, (x0, x1, y0, y1) = p.uniform("c", level=3)      # image[j, i], NaN outside the data
        s, c = p.sample_line("c", (0, 10), (50, 10), 200)
        for level, blocks, visible, values in p.leaves("phi", "c"):
            ...                                                # values[b, field, (k,) j, i]

Lengths are um from the domain's own origin (prob_lo added), arrays run (z,) y, x.
Run as a program it prints a summary of the files it is given.
"""
import re
import sys
from functools import cached_property, partial
from pathlib import Path

import h5py
import numpy as np

CHUNK_CELLS = 1 << 22  # cells read at a time where a whole level might not fit in memory


class PlotfileError(Exception):
    """What is wrong with a file or a request, in one line."""


class Level:
    """One level of the tree: equal blocks of n^dim cells of size dx, parents of finer blocks included."""

    def __init__(self, plot, index):
        group = plot.file[f"level_{index}"]
        self.plot, self.index, self.group = plot, index, group
        self.dx = float(group.attrs["dx"])
        dim, boxes, domain = plot.dim, group["boxes"][:], group.attrs["prob_domain"]
        corners = np.stack([boxes[name] for name in boxes.dtype.names], axis=1).astype(np.int64)
        self.boxes = corners.reshape(-1, 2, dim)  # [block, lo|hi, axis], hi inclusive
        self.lo = self.boxes[:, 0]
        self.nb = len(corners)
        self.n = int(self.boxes[0, 1, 0] - self.lo[0, 0] + 1) if self.nb else 0
        if (self.boxes[:, 1] - self.lo + 1 != self.n).any():
            raise PlotfileError(f"{plot.path}: level {index} has blocks of different sizes")
        self.domain = np.array([domain[name] for name in domain.dtype.names]).reshape(2, dim)
        self.shape = (self.n,) * dim  # of one block

    @property
    def data(self):
        """All components, [block, component, (k,) j, i]; read at each use, so keep what it returns."""
        return self.group["data:datatype=0"][:].reshape(self.nb, -1, *self.shape)

    def field(self, name, blocks=None):
        """One field of all blocks, or of the blocks with the given ascending numbers: [block, (k,) j, i]."""
        size, stored = self.n**self.plot.dim, self.group["data:datatype=0"]
        component, ncomp = self.plot.component(name), len(self.plot.fields)
        return self._runs(blocks, stored.dtype, lambda first, count: stored[h5py.MultiBlockSlice(
            start=(first * ncomp + component) * size, stride=ncomp * size, count=count, block=size)])

    def covered(self, blocks=None):
        """True on cells that finer blocks hide, [block, (k,) j, i]."""
        size, stored = self.n**self.plot.dim, self.plot.file[f"VTKHDF/Level{self.index}/CellData/vtkGhostType"]
        return self._runs(blocks, bool, lambda first, count: stored[first * size:(first + count) * size] != 0)

    def _runs(self, blocks, dtype, read):
        """Reads run by run of consecutive blocks: few calls for a level, little data for a slice or a zoom."""
        blocks = np.arange(self.nb) if blocks is None else np.asarray(blocks)
        out = np.empty((len(blocks), self.n**self.plot.dim), dtype)
        starts = np.flatnonzero(np.diff(blocks, prepend=-2) != 1)
        for a, b in zip(starts, np.append(starts[1:], len(blocks))):
            out[a:b] = read(int(blocks[a]), int(b - a)).reshape(b - a, -1)
        return out.reshape(len(blocks), *self.shape)

    def chunks(self, blocks=None):
        """The blocks in portions small enough to hold in memory."""
        blocks = np.arange(self.nb) if blocks is None else blocks
        step = max(1, CHUNK_CELLS // max(1, self.n**self.plot.dim))
        return (blocks[i:i + step] for i in range(0, len(blocks), step))

    @cached_property
    def is_leaf(self):
        """True for blocks with at least one visible cell."""
        parts = [~self.covered(b).reshape(len(b), -1).all(axis=1) for b in self.chunks()]
        return np.concatenate(parts) if parts else np.zeros(0, bool)


class Plotfile:
    def __init__(self, path):
        self.path, self.cache = Path(path), {}  # cache: for the user's own use
        if not self.path.is_file():
            raise PlotfileError(f"{path}: no such file")
        try:
            self.file = h5py.File(self.path, "r")
        except OSError as error:
            reason = "" if "signature" in str(error) or "truncated" in str(error) else f": {error}"
            raise PlotfileError(f"{path}: not an HDF5 file, or one cut short{reason}") from None
        try:
            self._read_header()
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            self.close()
            raise PlotfileError(f"{path}: not a plotfile ({error.args[0] if error.args else error})") from None

    def _read_header(self):
        root = self.file.attrs
        self.time_s, self.step = float(root["time"]), int(root["iteration"])
        self.dim = int(self.file["Chombo_global"].attrs["SpaceDim"])
        names = (root[f"component_{i}"] for i in range(int(root["num_components"])))
        self.fields = [n.decode() if isinstance(n, bytes) else str(n) for n in names]
        self.levels = [Level(self, i) for i in range(int(root["num_levels"]))]
        self.origin = np.array([root["prob_lo"][axis] for axis in "xyz"[:self.dim]])
        base = self.levels[0]
        self.lo = self.origin + base.domain[0] * base.dx
        self.hi = self.origin + (base.domain[1] + 1) * base.dx
        self.file["VTKHDF/Level0/CellData/vtkGhostType"]  # a plain Chombo file has no masks: say so at once

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        self.file.close()

    def component(self, name):
        if name not in self.fields:
            raise PlotfileError(f"{self.path}: no field '{name}'; it has {', '.join(self.fields)}")
        return self.fields.index(name)

    @property
    def blocks(self):
        return sum(int(level.is_leaf.sum()) for level in self.levels)

    @cached_property
    def cells(self):
        return sum(int((~level.covered(b)).sum()) for level in self.levels for b in level.chunks())

    def leaves(self, *fields):
        """Yields (level, block numbers, visible[b, (k,) j, i], values[b, field, (k,) j, i]) in portions."""
        for level in self.levels:
            for blocks in level.chunks(np.flatnonzero(level.is_leaf)):
                values = [level.field(name, blocks) for name in fields]
                yield level, blocks, ~level.covered(blocks), np.stack(values, axis=1) if fields else None

    def integral(self, field):
        """Integral over the domain, in the field's unit times um^dim."""
        return sum(float(values[:, 0][visible].sum()) * level.dx**self.dim
                   for level, _, visible, values in self.leaves(field))

    def min(self, field):
        return min(float(values[:, 0][visible].min()) for _, _, visible, values in self.leaves(field))

    def max(self, field):
        return max(float(values[:, 0][visible].max()) for _, _, visible, values in self.leaves(field))

    # ---- pictures: visible data on a uniform array ----------------------------------------------------

    def plane_axes(self, axis="z"):
        """Numbers of the horizontal and the vertical axis of a picture cut across `axis`."""
        return (0, 1) if self.dim == 2 else tuple(a for a in range(3) if a != "xyz".index(axis))

    def window(self, axis="z", box=None):
        """(x0, x1, y0, y1) of the domain in the plane of the picture, cut to `box`."""
        h, v = self.plane_axes(axis)
        x0, x1, y0, y1 = self.lo[h], self.hi[h], self.lo[v], self.hi[v]
        if box is not None:
            x0, x1, y0, y1 = max(x0, box[0]), min(x1, box[1]), max(y0, box[2]), min(y1, box[3])
            if x0 >= x1 or y0 >= y1:
                raise PlotfileError(f"{self.path}: the window {box} lies outside the domain "
                                    f"{self.lo[h]:g},{self.hi[h]:g},{self.lo[v]:g},{self.hi[v]:g}")
        return np.array([x0, x1, y0, y1])

    def level_for(self, pixels, axis="z", box=None, beyond=0):
        """The level whose cells put about `pixels` on the longer side; at most `beyond` above the finest."""
        x0, x1, y0, y1 = self.window(axis, box)
        wanted = np.log2(pixels * self.levels[0].dx / max(x1 - x0, y1 - y0))
        return int(np.clip(round(wanted), 0, len(self.levels) - 1 + beyond))

    def plane(self, axis="z", position=None):
        """Where the plane of a 3D picture lies: `position`, by default the middle."""
        a = "xyz".index(axis)
        position = (self.lo[a] + self.hi[a]) / 2 if position is None else position
        if not self.lo[a] <= position <= self.hi[a]:
            raise PlotfileError(f"{self.path}: {axis} = {position:g} um lies outside the domain, "
                                f"{self.lo[a]:g} to {self.hi[a]:g}")
        return position

    def cut(self, level, axis="z", position=None):
        """Blocks of a level that the plane meets and the plane's layer in each; 2D: all blocks, no layer."""
        if self.dim == 2:
            return np.arange(level.nb), None
        a, position = "xyz".index(axis), self.plane(axis, position)
        # Found on the finest level and halved, so that round-off cannot put two levels on different sides.
        finest = self.levels[-1]
        k = min(int(np.floor((position - self.origin[a]) / finest.dx)), int(finest.domain[1, a]))
        layer = (k >> (finest.index - level.index)) - level.lo[:, a]
        blocks = np.flatnonzero((layer >= 0) & (layer < level.n))
        return blocks, layer[blocks]

    def uniform(self, field, level=None, axis="z", position=None, box=None, mean=True, smooth=False):
        """Visible data on cells of `level` (default: the finest): image[j, i] and its (x0, x1, y0, y1).

        3D: on the plane axis = position (default: through the middle). Finer cells are averaged, or with
        mean=False one of them is taken: for angles and labels, whose averages mean nothing. Coarser cells
        fill the pixels they cover, or with smooth=True are interpolated linearly between their centres.
        A level above the finest gives pixels smaller than any cell.
        """
        level = len(self.levels) - 1 if level is None else level
        plane = list(self.plane_axes(axis))
        dx, window, origin = self.levels[0].dx / 2**level, self.window(axis, box), self.origin[plane]
        lo = np.floor((window[::2] - origin) / dx + 1e-9).astype(int)
        hi = np.ceil((window[1::2] - origin) / dx - 1e-9).astype(int)
        # A canvas a level from 0 to `level`: the window, even-sided, with a rim for the interpolation.
        corners, (start, stop) = {}, (lo, hi)
        for index in range(level, -1, -1):
            corners[index] = start - start % 2, stop + stop % 2
            start, stop = corners[index][0] // 2 - 1, corners[index][1] // 2 + 1
        total = {index: np.zeros((b - a)[::-1]) for index, (a, b) in corners.items()}
        weight = {index: np.zeros_like(canvas) for index, canvas in total.items()}
        for source in self.levels:
            target, down = min(source.index, level), max(0, source.index - level)
            start, stop = corners[target]
            blocks, layers = self.cut(source, axis, position)
            first = source.lo[blocks][:, plane]
            near = ((first + source.n - 1 >> down >= start) & (first >> down < stop)).all(axis=1)
            for part in source.chunks(np.flatnonzero(near & source.is_leaf[blocks])):
                values, visible = source.field(field, blocks[part]), ~source.covered(blocks[part])
                if layers is not None:  # [k, j, i]: axis x is the last
                    layer = layers[part].reshape(-1, 1, 1, 1)
                    values, visible = (np.take_along_axis(q, layer, 3 - "xyz".index(axis)).reshape(
                        len(part), source.n, source.n) for q in (values, visible))
                cell = (first[part][..., None] + np.arange(source.n) >> down) - start[:, None]
                i, j = np.broadcast_arrays(cell[:, 0, None, :], cell[:, 1, :, None])
                use = visible & (i >= 0) & (i < stop[0] - start[0]) & (j >= 0) & (j < stop[1] - start[1])
                at = np.ravel_multi_index((j[use], i[use]), total[target].shape)
                if mean:
                    add = partial(np.bincount, at, minlength=total[target].size)
                    total[target] += add(values[use]).reshape(total[target].shape) / 4**down
                    weight[target] += add().reshape(total[target].shape) / 4**down
                else:
                    total[target].flat[at], weight[target].flat[at] = values[use], 1
        if smooth:  # averages below finer cells, for the interpolation to lean on
            for index in range(level, 0, -1):
                (j, i), (a, b) = (corners[index][0] // 2 - corners[index - 1][0])[::-1], total[index].shape
                for canvas in (total, weight):
                    quarter = canvas[index].reshape(a // 2, 2, b // 2, 2).sum(axis=(1, 3)) / 4
                    canvas[index - 1][j:j + a // 2, i:i + b // 2] += quarter
        image = None
        for index in range(level + 1):
            known = weight[index] > 0
            own = np.divide(total[index], weight[index], out=np.full(known.shape, np.nan), where=known)
            image = own if image is None else np.where(
                known, own, _prolong(image, corners[index - 1][0], *corners[index], smooth))
        (i0, j0), (i1, j1) = lo - corners[level][0], hi - corners[level][0]
        (x0, y0), (x1, y1) = origin + lo * dx, origin + hi * dx
        return image[j0:j1, i0:i1], (x0, x1, y0, y1)

    # ---- points and lines -----------------------------------------------------------------------------

    def sample(self, field, points):
        """Values of the visible cells that hold the points [m, dim], and the sizes of those cells."""
        points = np.atleast_2d(np.asarray(points, float))
        out, size = np.full((2, len(points)), np.nan)
        for level in reversed(self.levels):  # the finest block with the point in it is the visible one
            if not level.nb:
                continue
            cell = np.floor((points - self.origin) / level.dx).astype(np.int64)
            cell = np.clip(cell, level.domain[0], level.domain[1])
            extent = tuple(level.domain[1] // level.n + 1)
            key = np.ravel_multi_index(tuple((cell // level.n).T), extent)
            keys = np.ravel_multi_index(tuple((level.lo // level.n).T), extent)
            order = np.argsort(keys)
            found = order[np.clip(np.searchsorted(keys, key, sorter=order), 0, level.nb - 1)]
            hit = np.isnan(size) & (keys[found] == key)
            if hit.any():
                blocks, which = np.unique(found[hit], return_inverse=True)
                inside = (cell[hit] - level.lo[found[hit]])[:, ::-1]  # z, y, x
                out[hit] = level.field(field, blocks)[(which, *inside.T)]
                size[hit] = level.dx
        return out, size

    def sample_line(self, field, start, end, count=500):
        """(s, values) at `count` points from start to end, s in um: linear between the centres of equal cells,
        off by up to half a cell in place next to a change of level and at the domain's edge."""
        s = np.linspace(0, 1, count)[:, None]
        start, end = np.asarray(start, float), np.asarray(end, float)
        points = start + s * (end - start)
        _, size = self.sample(field, points)
        # Corners of the box of cell centres around each point, by the size of the cell that holds it.
        unit = (points - self.origin) / size[:, None] - 0.5
        base, values = np.floor(unit), np.zeros(count)
        for corner in np.ndindex(*(2,) * self.dim):
            weight = np.prod(np.where(corner, unit - base, 1 - (unit - base)), axis=1)
            values += weight * self.sample(field, self.origin + (base + corner + 0.5) * size[:, None])[0]
        return s[:, 0] * np.linalg.norm(end - start), values


def _prolong(image, coarse_start, start, stop, smooth):
    """A canvas on cells of half the size: bilinear over the cells that hold data, or the cell itself."""
    known = np.isfinite(image)
    value, known = np.where(known, image, 0), known.astype(float)
    for axis in (0, 1):
        cells = np.arange(start[1 - axis], stop[1 - axis])
        near = cells // 2 - coarse_start[1 - axis]
        if smooth:
            far = near + np.where(cells % 2, 1, -1)
            value, known = (0.75 * q.take(near, axis) + 0.25 * q.take(far, axis) for q in (value, known))
        else:
            value, known = value.take(near, axis), known.take(near, axis)
    return np.divide(value, known, out=np.full_like(value, np.nan), where=known > 0)


def find_plotfiles(folder):
    """The plotfiles of a folder in the order of their steps."""
    if not Path(folder).is_dir():
        raise PlotfileError(f"{folder}: no such folder")
    files = [(int(m[1]), f) for f in Path(folder).iterdir() if (m := re.fullmatch(r"plt_(\d+)\.hdf", f.name))]
    if not files:
        raise PlotfileError(f"{folder}: no plotfiles (plt_*.hdf) in it")
    return [f for _, f in sorted(files)]


def main():
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print("usage: plotfile.py FILE...   (blocks, cells, and min, max, integral of every field)")
        return 0 if len(sys.argv) > 1 else 2
    for path in sys.argv[1:]:
        with Plotfile(path) as p:
            print(f"{path}: t = {p.time_s:.6g} s, step {p.step}, {p.dim}D, {len(p.levels)} levels, "
                  f"{p.blocks} blocks, {p.cells} cells, {p.lo} to {p.hi} um")
            for name in p.fields:
                print(f"  {name:12s} min {p.min(name):.10g}  max {p.max(name):.10g}  integral {p.integral(name):.10g}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (PlotfileError, OSError) as problem:
        print(f"plotfile.py: {problem}", file=sys.stderr)
        sys.exit(2)

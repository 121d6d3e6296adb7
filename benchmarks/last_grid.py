#!/usr/bin/python3
"""Where multigrid for a fluid with stiff solids should end: iterations against the size of the last grid.

usage: benchmarks/last_grid.py [CELLS]      (along a side, a power of 2; default 128; needs numpy and scipy)

One uniform staggered grid in the unit box with walls, velocities alone: sigma v - div[nu (grad v + grad v^T)] = f with
sigma dx^2 = 1/500 and nu from 1 to `ratio` in the solids, as in docs/performance.md. All matrices are put together, so that
ways to make coarse operators can be compared that the program does not have. Smoother, transfer and conjugate residuals are
those of src/amr/multigrid.cpp and src/amr/krylov.cpp; the last grid is solved directly."""
import sys

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

STEPS, LOWEST = 3, 12.0  # of the Chebyshev smoother
KEPT, MOST, TOLERANCE = 16, 80, 1e-8
RATIOS = (1e2, 1e4, 1e6, 1e8)


# ---- operators: velocity u[i, j] on faces i (walls left out) of rows j, v likewise ----

def differences(n):
    return sp.diags([-np.ones(n), np.ones(n)], [0, 1], shape=(n, n + 1))


def across(n):
    """Differences between rows, at the n + 1 lines between and beside them; beyond walls the opposite value."""
    d = sp.lil_matrix((n + 1, n))
    for line in range(n + 1):
        if line < n:
            d[line, line] += 2 if line == 0 else 1
        if line > 0:
            d[line, line - 1] -= 2 if line == n else 1
    return d.tocsr() * n


def operator(n, sigma, nu, edges):
    inner = sp.identity(n + 1, format="csr")[1:n]
    same, along = sp.identity(n), differences(n) @ inner.T * n
    xx, yy = sp.kron(along, same), sp.kron(same, along)
    shear = sp.hstack([sp.kron(inner.T, across(n)), sp.kron(across(n), inner.T)]).tocsr()
    half = np.ones((n + 1, n + 1))  # half the area at walls
    half[[0, -1], :] *= 0.5
    half[:, [0, -1]] *= 0.5
    stretch = sp.block_diag([xx.T @ sp.diags(2 * nu.ravel()) @ xx, yy.T @ sp.diags(2 * nu.ravel()) @ yy])
    return (stretch + shear.T @ sp.diags((half * edges).ravel()) @ shear + sigma * sp.identity(stretch.shape[0])).tocsr()


def interpolation(n):
    """Linear, from n/2 cells a side."""
    rows, planes = sp.lil_matrix((n, n // 2)), sp.lil_matrix((n - 1, n // 2 - 1))
    for fine in range(n):
        near, far = fine // 2, fine // 2 + (1 if fine % 2 else -1)
        rows[fine, near] += 0.75
        if 0 <= far < n // 2:
            rows[fine, far] += 0.25
        else:
            rows[fine, near] -= 0.25
    for fine in range(1, n):
        for coarse in {fine // 2, (fine + 1) // 2} & set(range(1, n // 2)):
            planes[fine - 1, coarse - 1] = 1 if fine % 2 == 0 else 0.5
    return rows.tocsr(), planes.tocsr()


def transfers(n):
    rows, planes = interpolation(n)
    pairs = sp.kron(sp.identity(n // 2), np.full((1, 2), 0.5))
    weighted = planes.T * 0.5
    return (sp.block_diag([sp.kron(planes, rows), sp.kron(rows, planes)]).tocsr(),
            sp.block_diag([sp.kron(weighted, pairs), sp.kron(pairs, weighted)]).tocsr())


# ---- coarse viscosities ----

def mean_of_roots(a):
    r = np.sqrt(a)
    return (0.25 * (r[:-1, :-1] + r[1:, :-1] + r[:-1, 1:] + r[1:, 1:])) ** 2


def round_edges(nu):
    return mean_of_roots(np.pad(nu, 1, mode="edge"))


def from_coarse_cells(nu):
    coarse = mean_of_roots(nu)[::2, ::2]
    return coarse, round_edges(coarse)


def from_finer_cells(nu):
    return mean_of_roots(nu)[::2, ::2], round_edges(nu)[::2, ::2]


class Level:
    def __init__(self, n, matrix):
        self.n, self.matrix = n, matrix
        self.inverse = 2 / np.asarray(abs(matrix).sum(axis=1)).ravel()


def ladder(n, sigma, nu, edges, last, coarsen):
    levels = [Level(n, operator(n, sigma, nu, edges))]
    while levels[-1].n > last:
        fine = levels[-1]
        fine.up, fine.down = transfers(fine.n)
        if coarsen is None:  # Galerkin
            matrix = (fine.up.T @ fine.matrix @ fine.up * 0.25).tocsr()
        else:
            nu, edges = coarsen(nu)
            matrix = operator(fine.n // 2, sigma, nu, edges)
        levels.append(Level(fine.n // 2, matrix))
    levels[-1].solve = scipy.sparse.linalg.splu(levels[-1].matrix.tocsc()).solve
    return levels


def smooth(level, x, b):
    middle, half = 1 + 1 / LOWEST, 1 - 1 / LOWEST
    rho = half / middle
    step = level.inverse * (b - level.matrix @ x) / middle
    for k in range(STEPS):
        x = x + step
        if k + 1 < STEPS:
            following = 1 / (2 * middle / half - rho)
            step = following * rho * step + 2 * following / half * level.inverse * (b - level.matrix @ x)
            rho = following
    return x


def cycle(levels, b):
    here = levels[0]
    if len(levels) == 1:
        return here.solve(b)
    x = smooth(here, np.zeros_like(b), b)
    x = x + here.up @ cycle(levels[1:], here.down @ (b - here.matrix @ x))
    return smooth(here, x, b)


def iterations(levels, b):
    r, z_kept, w_kept = b.copy(), [], []
    for count in range(1, MOST + 1):
        z = cycle(levels, r)
        w = levels[0].matrix @ z
        for _ in range(2):
            for older_z, older_w in zip(z_kept, w_kept):
                share = w @ older_w
                w, z = w - share * older_w, z - share * older_z
        length = np.linalg.norm(w)
        z_kept, w_kept = (z_kept + [z / length])[-KEPT:], (w_kept + [w / length])[-KEPT:]
        r -= (r @ w_kept[-1]) * w_kept[-1]
        if np.linalg.norm(r) < TOLERANCE * np.linalg.norm(b) and abs(r).max() < TOLERANCE * abs(b).max():
            return str(count)
    return "-"


# ---- scenes: signed distance from the solids, in cells ----

def disc(x, y, n, radius=0.2, at=(0.5, 0.5)):
    return n * (radius - np.hypot(x - at[0], y - at[1]))


def cross(x, y, n):
    def arm(p, q):
        return np.minimum(5 - n * abs(p - 0.5), n * (0.3 - abs(q - 0.5)))
    return np.maximum(arm(x, y), arm(y, x))


def two_discs(x, y, n):
    return np.maximum(disc(x, y, n, at=(0.28, 0.5)), disc(x, y, n, at=(0.68 + 2 / n, 0.5)))


def six_discs(x, y, n):
    places = [(0.43, 0.52), (0.6, 0.3), (0.2, 0.8), (0.75, 0.66), (0.3, 0.25), (0.4 + 3 / n, 0.25)]
    return np.max([disc(x, y, n, 0.05, at) for at in places], axis=0)


def main():
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 128
    centres, lines, wide = (np.arange(n) + 0.5) / n, np.arange(n + 1) / n, (np.arange(-1, n + 1) + 0.5) / n
    force = np.concatenate([(np.cos(3 * lines[1:-1, None]) * np.sin(5 * centres)).ravel(),
                            -(np.sin(5 * centres[:, None]) * np.cos(3 * lines[1:-1])).ravel()])
    ways = [(2, from_coarse_cells), (8, from_coarse_cells), (16, from_coarse_cells), (32, from_coarse_cells),
            (32, from_finer_cells), (32, None)]
    print("scene,last_grid,coarse_operator," + ",".join(f"iterations_{r:.0e}" for r in RATIOS))
    for scene in (disc, cross, two_discs, six_discs):
        for last, coarsen in ways:
            counts = []
            for ratio in RATIOS:
                phi = np.tanh(scene(wide[:, None], wide, n) / 2)
                at_edges = 0.25 * (phi[1:, 1:] + phi[:-1, 1:] + phi[1:, :-1] + phi[:-1, :-1])
                nu, edges = (1 + (ratio - 1) * 0.5 * (1 + p) for p in (phi[1:-1, 1:-1], at_edges))
                counts.append(iterations(ladder(n, n * n / 500, nu, edges, last, coarsen), force))
            print(f"{scene.__name__},{last},{coarsen.__name__ if coarsen else 'galerkin'}," + ",".join(counts), flush=True)


main()

/* phi_form: the alloy model discretised as in the papers before it: the unknown is phi itself, on one uniform
   grid, with explicit Euler steps and the plain five-point differences (or, with isotropic = 1, nine-point
   ones). It is not part of the program. tools/verify.py builds and runs it to tell how far the lattice of
   such a grid moves the published numbers: the leading error of five-point differences is itself a four-fold
   anisotropy of the surface energy, -(dx/W0)^2/240 (Karma & Rappel, Phys. Rev. E 57, 4323, 1998, Sec. V).
   Usage: phi_form dx isotropic W0/d0 Omega k eps4 seed/d0 box/d0 end(tD/d0^2) [every]
   Prints one line "t D/d0^2, tip/d0" every `every` (default 50); quarter of a crystal, mirror-sided box. */
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

namespace {

struct Grid {
  int n, row;
  std::vector<double> phi, u, c, rate, flux_x, flux_y;
  explicit Grid(int cells) : n(cells), row(cells + 2) {
    const std::size_t size = static_cast<std::size_t>(row) * static_cast<std::size_t>(row);
    for (auto* a : {&phi, &u, &c, &rate, &flux_x, &flux_y}) a->assign(size, 0.0);
  }
  std::size_t at(int i, int j) const {
    return static_cast<std::size_t>(j + 1) * static_cast<std::size_t>(row) + static_cast<std::size_t>(i + 1);
  }
  void mirror(std::vector<double>& a) const {
    for (int j = 0; j < n; ++j) a[at(-1, j)] = a[at(0, j)], a[at(n, j)] = a[at(n - 1, j)];
    for (int i = -1; i <= n; ++i) a[at(i, -1)] = a[at(i, 0)], a[at(i, n)] = a[at(i, n - 1)];
  }
};

// One component of the flux of eq. (1) through a face, from the gradient there.
inline double phase_flux(double along, double across, double eps) {
  const double x = along * along, y = across * across, g = x + y + 1e-20, s = (x * x + y * y) / (g * g);
  const double a = 1 - 3 * eps + 4 * eps * s;
  return along * (a * a + 16 * eps * a * (x / g - s));
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 10) return std::fprintf(stderr, "usage: see the head of phi_form.cpp\n"), 2;
  const double dx = std::atof(argv[1]), iso = std::atof(argv[2]) / 6, ratio = std::atof(argv[3]);
  const double omega = std::atof(argv[4]), k = std::atof(argv[5]), eps = std::atof(argv[6]);
  const double seed = std::atof(argv[7]) / ratio, lambda = 0.8839 * ratio, diffusivity = 0.6267 * lambda;
  const double unit = diffusivity * ratio * ratio, end = std::atof(argv[9]) / unit;
  const double every = (argc > 10 ? std::atof(argv[10]) : 50) / unit,
               dt = std::min(0.2 * dx * dx / diffusivity, 0.02);
  Grid g(static_cast<int>(std::atof(argv[8]) / ratio / dx));
  const double k1 = 1 - k, h = 1 / dx;
  for (int j = 0; j < g.n; ++j)
    for (int i = 0; i < g.n; ++i) {
      const double r = std::hypot((i + 0.5) * dx, (j + 0.5) * dx);
      const double phi = std::tanh((seed - r) / std::sqrt(2.0));
      g.phi[g.at(i, j)] = phi;
      g.c[g.at(i, j)] = (1 + k - k1 * phi) / 2 * (1 - k1 * omega);
    }
  double next = 0;
  const auto R = static_cast<std::ptrdiff_t>(g.row);
  int reach = static_cast<int>(seed / dx) + 40;  // beyond it phi is -1
  for (double t = 0; t < end + 0.5 * dt; t += dt) {
    g.mirror(g.phi);
    for (int j = 0; j < g.n; ++j)
      for (std::size_t q = g.at(0, j), e = g.at(g.n, j); q < e; ++q)
        g.u[q] = (2 * g.c[q] / (1 + k - k1 * g.phi[q]) - 1) / k1;
    g.mirror(g.u);
    if (t >= next) {
      next += every;
      double tip = 0;
      for (int i = 0; i + 1 < g.n; ++i) {
        // Cells straddle the axis by half a spacing; phi is even across it, so 9/8, -1/8 gives its value
        // there.
        const auto axis = [&](int q) { return 1.125 * g.phi[g.at(q, 0)] - 0.125 * g.phi[g.at(q, 1)]; };
        const double a = axis(i), b = axis(i + 1);
        if (a > 0 && b <= 0) {
          const auto psi = [](double p) { return std::atanh(std::clamp(p, -1 + 1e-12, 1 - 1e-12)); };
          tip = (i + 0.5 + psi(a) / (psi(a) - psi(b))) * dx;
          break;
        }
      }
      std::printf("%.2f %.6f\n", t * unit, tip * ratio);
      std::fflush(stdout);
      reach = std::max(reach, static_cast<int>(tip / dx) + 40);
    }
    const int m = std::min(g.n, reach);
    const double* p = g.phi.data();
    const auto phase = [&](std::size_t q, std::ptrdiff_t A, std::ptrdiff_t B) {
      const double* f = p + q;
      return h * phase_flux(f[A] - f[0], 0.25 * ((f[B] - f[-B]) + (f[A + B] - f[A - B])), eps);
    };
    for (int j = 0; j < m; ++j)
#pragma GCC ivdep
      for (int i = 0; i < m; ++i) {
        const std::size_t q = g.at(i, j);
        g.flux_x[q] = phase(q, 1, R);
        g.flux_y[q] = phase(q, R, 1);
      }
    for (int j = 0; j < m; ++j) g.flux_x[g.at(-1, j)] = 0;
    for (int i = 0; i < m; ++i) g.flux_y[g.at(i, -1)] = 0;
    // Isotropic form: the correction (dx^2/6) d2x d2y phi of the Laplacian; its coefficient a_s^2 is
    // nearly 1.
    for (int j = 0; j < m; ++j)
#pragma GCC ivdep
      for (int i = 0; i < m; ++i) {
        const std::size_t q = g.at(i, j);
        const double* f = p + q;
        const double gx = 0.5 * (f[1] - f[-1]), gy = 0.5 * (f[R] - f[-R]), x = gx * gx, y = gy * gy,
                     g2 = x + y + 1e-20;
        const double a = 1 - 3 * eps + 4 * eps * (x * x + y * y) / (g2 * g2), w = 1 - f[0] * f[0];
        const double corners =
            (f[R + 1] + f[R - 1]) + (f[1 - R] + f[-1 - R]) - 2 * ((f[1] + f[-1]) + (f[R] + f[-R])) + 4 * f[0];
        const double div = h * (g.flux_x[q] - g.flux_x[q - 1] + g.flux_y[q] - g.flux_y[q - g.row]) +
                           iso * h * h * a * a * corners;
        g.rate[q] = (div + f[0] * w - lambda * w * w * g.u[q]) / (a * a);
      }
    g.mirror(g.rate);
    const auto solute = [&](std::size_t q, std::ptrdiff_t A, std::ptrdiff_t B) {
      const double *f = p + q, *u = g.u.data() + q, *r = g.rate.data() + q;
      const double dn = f[A] - f[0], ds = 0.25 * ((f[B] - f[-B]) + (f[A + B] - f[A - B]));
      return diffusivity * (1 - 0.5 * (f[0] + f[A])) / 2 * h * (u[A] - u[0]) +
             0.5 / std::sqrt(2.0) * (1 + k1 * 0.5 * (u[0] + u[A])) * 0.5 * (r[0] + r[A]) * dn /
                 std::sqrt(dn * dn + ds * ds + 1e-20);
    };
    for (int j = 0; j < g.n; ++j)
#pragma GCC ivdep
      for (int i = 0; i < g.n; ++i) {
        const std::size_t q = g.at(i, j);
        g.flux_x[q] = solute(q, 1, R);
        g.flux_y[q] = solute(q, R, 1);
      }
    for (int j = 0; j < g.n; ++j) g.flux_x[g.at(-1, j)] = g.flux_x[g.at(g.n - 1, j)] = 0;
    for (int i = 0; i < g.n; ++i) g.flux_y[g.at(i, -1)] = g.flux_y[g.at(i, g.n - 1)] = 0;
    for (int j = 0; j < g.n; ++j)
#pragma GCC ivdep
      for (int i = 0; i < g.n; ++i) {
        const std::size_t q = g.at(i, j);
        g.c[q] += dt * h * k1 * (g.flux_x[q] - g.flux_x[q - 1] + g.flux_y[q] - g.flux_y[q - g.row]);
        g.phi[q] += dt * g.rate[q];
      }
  }
  return 0;
}

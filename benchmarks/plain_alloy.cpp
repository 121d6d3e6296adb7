#include "plain_alloy.hpp"

#include <algorithm>
#include <cstdlib>
#include <new>
#include <utility>

#include "amr/loops.hpp"

namespace dendrift::bench {

using physics::AlloyParameters;
using physics::fast_exp;
using physics::fast_rsqrt;
using physics::PSI_MAX;
using physics::SQRT2;
using physics::Stage;

namespace {

constexpr int GHOSTS = 2;
constexpr int MARGIN = 8;  // doubles before and after the cells of a row: rows start on a cache line, end in whole vectors
constexpr std::size_t ALIGNMENT = 64;
constexpr double STEEPEST = 4.0;  // as in the kernel

// exp(psi/sqrt2), t = (1-phi)/2 and U of N cells.
void primitives_row(int n, const double* __restrict psi, const double* __restrict c, double k, double* __restrict e_,
                    double* __restrict t_, double* __restrict u_) {
  const double rk = 1.0 / (1.0 - k);
#pragma omp simd
  for (int i = 0; i < n; ++i) {
    const double e = fast_exp(psi[i] * (1.0 / SQRT2));
    const double a = 1.0 + e * e, b = 1.0 + k * e * e;
    const double inverse = 1.0 / (a * b);
    e_[i] = e;
    t_[i] = inverse * b;
    u_[i] = (c[i] * (inverse * a * a) - 1.0) * rk;
  }
}

// Eq. (1): D_t psi of N cells. Y and Z are the strides of psi.
void rate_row(int n, const double* __restrict psi, const double* __restrict t_, const double* __restrict u_,
              const AlloyParameters& p, double dx, std::ptrdiff_t Y, [[maybe_unused]] std::ptrdiff_t Z,
              double* __restrict rate) {
  const double b = 1.0 - 3.0 * p.epsilon, e4 = 4.0 * p.epsilon, e16 = 4.0 * e4, drive = 4.0 * SQRT2 * p.lambda;
  const double h2 = 1.0 / (dx * dx), tiny = 1e-12 * 144.0 * dx * dx, to_p2 = h2 / 144.0;
#pragma omp simd
  for (int i = 0; i < n; ++i) {
    const double* f = psi + i;
    // Isotropic stencils of 9 or 19 points, in units of the grid: p = 12 h grad psi, mxx = h^2 d2/dx2,
    // mxy = 4 h^2 d2/dxdy, laplacian = 6 h^2 lap.
    const double ee = f[1], w = f[-1], nn = f[Y], s = f[-Y];
    const double ne = f[Y + 1], nw = f[Y - 1], se = f[1 - Y], sw = f[-Y - 1];
    const double dx_xy = (ne - sw) + (se - nw), dy_xy = (ne - sw) - (se - nw), sxy = (ne + sw) + (nw + se);
    const double mxx = (ee + w) - 2.0 * f[0], myy = (nn + s) - 2.0 * f[0], mxy = (ne + sw) - (nw + se);
    double px, py, laplacian, p2, p4;
    [[maybe_unused]] double pz = 0, mzz = 0, mxz = 0, myz = 0, qz = 0;
    if constexpr (DIM == 2) {
      px = 4.0 * (ee - w) + dx_xy;
      py = 4.0 * (nn - s) + dy_xy;
      laplacian = 4.0 * ((ee + w) + (nn + s)) + sxy - 20.0 * f[0];
    } else {
      const double u = f[Z], d = f[-Z], eu = f[Z + 1], wu = f[Z - 1], ed = f[1 - Z], wd = f[-Z - 1];
      const double nu = f[Y + Z], su = f[Z - Y], nd = f[Y - Z], sd = f[-Y - Z];
      mzz = (u + d) - 2.0 * f[0];
      mxz = (eu + wd) - (wu + ed);
      myz = (nu + sd) - (su + nd);
      px = 2.0 * (ee - w) + (dx_xy + ((eu - wd) + (ed - wu)));
      py = 2.0 * (nn - s) + (dy_xy + ((nu - sd) + (nd - su)));
      pz = 2.0 * (u - d) + (((eu - wd) - (ed - wu)) + ((nu - sd) - (nd - su)));
      laplacian = 2.0 * ((ee + w) + (nn + s) + (u + d)) + (sxy + ((eu + wd) + (wu + ed)) + ((nu + sd) + (su + nd))) - 24.0 * f[0];
      qz = pz * pz;
    }
    const double qx = px * px, qy = py * py;
    p2 = tiny + ((qx + qy) + qz);
    p4 = qx * qx + qy * qy + qz * qz;
    const double p22 = p2 * p2;
    const double m = b * p22 + e4 * p4;  // a_s |grad psi|^4
    const double inverse = 1.0 / (p2 * m);
    const double ip2 = inverse * m, ip4 = ip2 * ip2;
    const double ratio = inverse * p2 * p22;  // 1 / a_s
    const double a = m * ip4, sum4 = p4 * ip4, as = a * sum4, a2 = a + a;
    const double x = qx * ip2 - sum4, y = qy * ip2 - sum4;
    const double ex = e16 * x, ey = e16 * y, sx = a2 * x + as, sy = a2 * y + as;
    double diagonal = qx * ((ex * x + 3.0 * a) - (sx + sx)) * mxx + qy * ((ey * y + 3.0 * a) - (sy + sy)) * myy;
    double off = (px * py) * (ex * y - (sx + sy)) * mxy;
    if constexpr (DIM == 3) {
      const double z = qz * ip2 - sum4, ez = e16 * z, sz = a2 * z + as;
      diagonal += qz * ((ez * z + 3.0 * a) - (sz + sz)) * mzz;
      off += (px * pz) * (ex * z - (sx + sz)) * mxz + (py * pz) * (ey * z - (sy + sz)) * myz;
    }
    const double aa = a * a;
    const double div = h2 * ((1.0 / 6.0) * (aa - e16 * as) * laplacian + (e16 * ip2) * (diagonal + 0.5 * off));
    const double t = t_[i], phi = 1.0 - 2.0 * t;
    const double r = ratio * ratio * (div + SQRT2 * phi * (1.0 - std::min(aa * (to_p2 * p2), STEEPEST)) - drive * (t - t * t) * u_[i]);
    const bool held = (f[0] >= PSI_MAX && r > 0) || (f[0] <= -PSI_MAX && r < 0);
    rate[i] = held ? 0.0 : r;
  }
}

struct FluxConstants {
  double half_k1, diffusion, offset, trapping;

  FluxConstants(const AlloyParameters& p, double dx) {
    const double k1 = 1.0 - p.k, e = fast_exp(PSI_MAX / SQRT2);
    half_k1 = 0.5 * k1;
    diffusion = k1 * p.diffusivity / dx;
    offset = 1.0 / (1.0 + e * e);
    trapping = k1 / 2.0;
  }
};

// Eq. (2): the flux of solute through N faces between cells 0, on the low side, and 1 of e, u and rate; A is the
// stride of psi across the face, B and C those along it.
void flux_row(int n, const double* __restrict psi, std::ptrdiff_t A, std::ptrdiff_t B,
              [[maybe_unused]] std::ptrdiff_t C, const double* e0, const double* e1, const double* u0,
              const double* u1, const double* rate0, const double* rate1, const FluxConstants& k,
              double* __restrict flux) {
  const FluxConstants q = k;
#pragma omp simd
  for (int i = 0; i < n; ++i) {
    const double* f = psi + i;
    const double dn = f[A] - f[0];
    const double db = 0.25 * ((f[B] - f[-B]) + (f[A + B] - f[A - B]));
    double g2 = dn * dn + 1e-24 + db * db;
    if constexpr (DIM == 3) {
      const double dc = 0.25 * ((f[C] - f[-C]) + (f[A + C] - f[A - C]));
      g2 += dc * dc;
    }
    const double normal = dn * fast_rsqrt(g2);
    const double r = 1.0 / (1.0 + e0[i] * e1[i]);
    const double enrichment = 1.0 + q.half_k1 * (u0[i] + u1[i]);
    flux[i] = q.diffusion * (r - q.offset) * (u1[i] - u0[i]) +
              q.trapping * r * (1.0 - r) * (rate0[i] + rate1[i]) * enrichment * normal;
  }
}

// One stage for N cells: z_lo, z_hi are the fluxes through the sides across the last axis; y_lo, y_hi (3D) those
// across y.
void update_row(int n, const Stage& stage, double dx, const double* __restrict psi, const double* __restrict c,
                const double* __restrict rate, const double* __restrict x, [[maybe_unused]] const double* y_lo,
                [[maybe_unused]] const double* y_hi, const double* z_lo, const double* z_hi,
                double* __restrict psi_next, double* __restrict c_next) {
  const double w = stage.weight / dx, nu = stage.nu, weight = stage.weight;
#pragma omp simd
  for (int i = 0; i < n; ++i) {
    double sum = (x[i] - x[i - 1]) + (z_hi[i] - z_lo[i]);
    if constexpr (DIM == 3) sum += y_hi[i] - y_lo[i];
    c_next[i] = (c[i] + nu * (c_next[i] - c[i])) + w * sum;
    const double p = (psi[i] + nu * (psi_next[i] - psi[i])) + weight * rate[i];
    psi_next[i] = std::min(std::max(p, -PSI_MAX), PSI_MAX);
  }
}

}  // namespace

void PlainAlloy::Free::operator()(double* p) const { std::free(p); }

PlainAlloy::Array PlainAlloy::allocate(std::ptrdiff_t doubles) {
  doubles += MARGIN;  // the last vector of the last row looks one cell beyond
  void* memory = std::aligned_alloc(ALIGNMENT, static_cast<std::size_t>(doubles) * sizeof(double));
  if (memory == nullptr) throw std::bad_alloc();
  auto* p = static_cast<double*>(memory);
  std::fill_n(p, doubles, 0.0);
  return Array(p);
}

PlainAlloy::PlainAlloy(int cells, double dx)
    : n_(cells), dx_(dx), row_(cells + 2 * MARGIN), slab_(DIM == 2 ? row_ : row_ * (cells + 2 * GHOSTS)) {
  for (Array* a : {&psi_, &c_, &psi_next_, &c_next_}) *a = allocate(slab_ * (cells + 2 * GHOSTS));
  for (Array* a : {&e_[0], &e_[1], &u_[0], &u_[1], &rate_[0], &rate_[1], &flux_across_[0], &flux_across_[1]})
    *a = allocate(slab_);
  for (Array* a : {&t_, &flux_x_, &flux_y_[0], &flux_y_[1]}) *a = allocate(row_);
}

std::ptrdiff_t PlainAlloy::offset(const IntVec& cell) const {
  std::ptrdiff_t o = MARGIN + cell[0] + (cell[DIM - 1] + GHOSTS) * slab_;
  if constexpr (DIM == 3) o += (cell[1] + GHOSTS) * row_;
  return o;
}

void PlainAlloy::swap() {
  std::swap(psi_, psi_next_);
  std::swap(c_, c_next_);
}

void PlainAlloy::mirror(double* a) const {
  for (int axis = 0; axis < DIM; ++axis) {
    IntVec lo = filled(-GHOSTS), size = filled(n_ + 2 * GHOSTS);
    for (int later = axis; later < DIM; ++later) {
      lo[later] = 0;
      size[later] = n_;
    }
    size[axis] = 1;
    for (int g = 0; g < GHOSTS; ++g) {
      const std::ptrdiff_t step = axis == 0 ? 1 : axis == DIM - 1 ? slab_ : row_;
      amr::for_each_cell(lo, size, [&](const IntVec& cell) {
        double* p = a + offset(cell);
        p[(-1 - g) * step] = p[g * step];
        p[(n_ + g) * step] = p[(n_ - 1 - g) * step];
      });
    }
  }
}

void PlainAlloy::fill_ghosts() {
  mirror(psi_.get());
  mirror(c_.get());
}

void PlainAlloy::advance(const AlloyParameters& p, const Stage& stage) {
  const FluxConstants constants(p, dx_);
  const int around = DIM == 2 ? 0 : 1;  // rows j of a slab, and one on either side in 3D
  const int rows = DIM == 2 ? 1 : n_;
  const int whole = (n_ + 2 + 7) / 8 * 8;  // cells of a row and its nearest ghosts, in whole vectors
  for (int k = -1; k <= n_; ++k) {
    const int now = k & 1, before = 1 - now;
    for (int j = -around; j < rows + around; ++j) {
      // 1. Row j of slab k: what the fluxes need of it, with one cell more at both ends.
      const std::ptrdiff_t row = MARGIN + (DIM == 2 ? 0 : (j + GHOSTS) * row_);
      const std::ptrdiff_t cell = row + (k + GHOSTS) * slab_;
      double *e = e_[now].get() + row, *u = u_[now].get() + row, *rate = rate_[now].get() + row;
      double* t = t_.get() + MARGIN;
      primitives_row(whole, psi_.get() + cell - 1, c_.get() + cell - 1, p.k, e - 1, t - 1, u - 1);
      rate_row(whole, psi_.get() + cell - 1, t - 1, u - 1, p, dx_, row_, slab_, rate - 1);
      if (k < 0 || j >= rows) continue;
      // 2. Row j of slab k-1: fluxes through its high sides.
      const std::ptrdiff_t at = cell - slab_;
      const double* psi = psi_.get() + at;
      const double *e0 = e_[before].get() + row, *u0 = u_[before].get() + row, *rate0 = rate_[before].get() + row;
      double *across_lo = flux_across_[now].get() + row, *across_hi = flux_across_[before].get() + row;
      if (j >= 0)
        flux_row(n_, psi, slab_, 1, row_, e0, e, u0, u, rate0, rate, constants, across_hi);
      if (k == 0) continue;
      double *y_lo = flux_y_[j & 1].get() + MARGIN, *y_hi = flux_y_[1 - (j & 1)].get() + MARGIN;
      if constexpr (DIM == 3)
        flux_row(n_, psi, row_, 1, slab_, e0, e0 + row_, u0, u0 + row_, rate0, rate0 + row_, constants, y_hi);
      if (j < 0) continue;
      double* x = flux_x_.get() + MARGIN;
      flux_row(whole, psi - 1, 1, row_, slab_, e0 - 1, e0, u0 - 1, u0, rate0 - 1, rate0, constants, x - 1);
      // 3. The next stage.
      update_row(n_, stage, dx_, psi, c_.get() + at, rate0, x, y_lo, y_hi, across_lo, across_hi,
                 psi_next_.get() + at, c_next_.get() + at);
    }
  }
}

}  // namespace dendrift::bench

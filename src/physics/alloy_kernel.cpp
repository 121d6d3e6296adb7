#include "physics/alloy_kernel.hpp"

#include <algorithm>
#include <bit>
#include <cstdint>
#include <vector>

#include "amr/loops.hpp"
#include "physics/counter_random.hpp"

namespace dendrift::physics {

namespace {

constexpr int GHOSTS = 2;

// Bound of a_s^2 |grad psi|^2 in the term that restores it to 1. Fronts slower than 2 W0/tau0 stay below; what is
// steeper (seeds that cut each other) then flattens at a bounded rate instead of outrunning the time step.
constexpr double STEEPEST = 4.0;

// Strides of a block of N cells a side, known to the compiler.
template <int N>
struct Shape {
  static constexpr int P = N + 2 * GHOSTS;
  static constexpr int SIZE = DIM == 2 ? P * P : P * P * P;
  static constexpr int Y = P;
  static constexpr int Z = DIM == 3 ? P * P : 0;
  static constexpr int ORIGIN = GHOSTS * (1 + Y + Z);
  static constexpr int stride(int a) { return a == 0 ? 1 : a == 1 ? Y : Z; }
  static constexpr int index(int i, int j, int k) { return i + j * Y + k * Z; }
};

// Loop over axes that is gone before the vectoriser looks: f(std::integral_constant<int, 0>), ...
template <class F>
[[gnu::always_inline]] inline void each_axis(F&& f) {
  f(std::integral_constant<int, 0>{});
  f(std::integral_constant<int, 1>{});
  if constexpr (DIM == 3) f(std::integral_constant<int, 2>{});
}
#define EACH_AXIS(a) each_axis([&](auto a) __attribute__((always_inline)) {
#define END_AXIS });

// Intermediate results of a block; indexed like the block's arrays, so that one index serves all. Loops run over
// contiguous memory, ghost columns included: longer vectors are worth more than the few cells wasted.
template <int N>
struct Scratch {
  alignas(64) double e[Shape<N>::SIZE];     // exp(psi / sqrt 2)
  alignas(64) double t[Shape<N>::SIZE];     // (1 - phi) / 2
  alignas(64) double u[Shape<N>::SIZE];     // U
  alignas(64) double rate[Shape<N>::SIZE];  // D_t psi
  alignas(64) double anti[Shape<N>::SIZE];  // the rate that the antitrapping current sees, if another
  alignas(64) double flux[DIM][Shape<N>::SIZE];  // through the high face of a cell
};

template <int N>
Scratch<N>& scratch() {
  thread_local std::vector<Scratch<N>> s(1);
  return s[0];
}

// (1 - phi)/2 between two cells held at +PSI_MAX, as the kernel computes it: subtracted so that no solute
// diffuses in bulk solid, exactly.
double solid_offset() {
  const double e = fast_exp(PSI_MAX / SQRT2);
  return 1.0 / (1.0 + e * e);
}

// Calls f(shift + q) for FIRST <= q <= LAST in whole vectors: the last one goes back over cells already done, which
// costs less than a loop over the few left. f must not mind being called twice.
template <int FIRST, int LAST, class F>
[[gnu::always_inline]] inline void run(int shift, F&& f) {
  constexpr int VECTOR = 8, COUNT = LAST - FIRST + 1, WHOLE = COUNT / VECTOR * VECTOR;
  const int first = shift + FIRST, last = shift + LAST;
#pragma omp simd
  for (int q = first; q < first + WHOLE; ++q) f(q);
  if constexpr (WHOLE < COUNT) {
#pragma omp simd
    for (int q = last - VECTOR + 1; q <= last; ++q) f(q);
  }
}

// f(q) for the cells of a block and their nearest neighbours (3D: without the edges of that cube). Between pieces of
// the work meanwhile(piece, pieces) is called.
template <int N, class F, class Meanwhile>
[[gnu::always_inline]] inline void around(F&& f, Meanwhile&& meanwhile) {
  using S = Shape<N>;
  constexpr int FIRST = S::index(-1, -1, 0), LAST = S::index(N, N, 0);
  if constexpr (DIM == 2) {
    constexpr int PIECE = 64, PIECES = (LAST - FIRST + 1) / PIECE;
    for (int i = 0; i < PIECES - 1; ++i) {
      meanwhile(i, PIECES);
      run<FIRST, FIRST + PIECE - 1>(i * PIECE, f);
    }
    meanwhile(PIECES - 1, PIECES);
    run<FIRST + (PIECES - 1) * PIECE, LAST>(0, f);
  } else {
    for (int k = -1; k <= N; ++k) {
      meanwhile(k + 1, N + 2);
      if (k < 0 || k == N) {
        run<S::index(-1, 0, 0), S::index(N, N - 1, 0)>(k * S::Z, f);
      } else {
        run<FIRST, LAST>(k * S::Z, f);
      }
    }
  }
}

// f(q) for the cells on the low side of every face across AXIS.
template <int N, int AXIS, class F>
[[gnu::always_inline]] inline void faces(F&& f) {
  using S = Shape<N>;
  constexpr int FIRST = S::index(AXIS == 0 ? -1 : 0, AXIS == 1 ? -1 : 0, 0), LAST = S::index(N - 1, N - 1, 0);
  if constexpr (DIM == 2) {
    run<FIRST, LAST>(0, f);
  } else {
    for (int k = AXIS == 2 ? -1 : 0; k < N; ++k) run<FIRST, LAST>(k * S::Z, f);
  }
}

// Asks for one of `pieces` parts of the interior of an array.
template <int N>
[[gnu::always_inline]] inline void fetch(const double* array, int piece, int pieces) {
  if (array == nullptr) return;
  constexpr int COUNT = Shape<N>::index(N - 1, N - 1, N - 1) + 1, LINE = 8;
  for (int q = COUNT * piece / pieces; q < COUNT * (piece + 1) / pieces; q += LINE) __builtin_prefetch(array + q, 1);
}

template <int N>
void primitives(const double* psi, const double* c, double k, Scratch<N>& s) {
  using S = Shape<N>;
  const double scale = 1.0 / SQRT2, rk = 1.0 / (1.0 - k);
  double* e_ = s.e + S::ORIGIN;
  double* t_ = s.t + S::ORIGIN;
  double* u_ = s.u + S::ORIGIN;
  around<N>(
      [=](int q) __attribute__((always_inline)) {
        const double e = fast_exp(psi[q] * scale);
        const double a = 1.0 + e * e, b = 1.0 + k * e * e;
        const double inverse = 1.0 / (a * b);
        e_[q] = e;
        t_[q] = inverse * b;                            // 1/(1+e^2)
        u_[q] = (c[q] * (inverse * a * a) - 1.0) * rk;  // [1+k-(1-k)phi]/2 = b/a
      },
      [](int, int) {});
}

// Derivatives of psi at a cell, in units of the grid that save products: p is 12 h grad psi, m the Hessian times h^2
// on the diagonal and 4 h^2 beside it, laplacian 6 h^2 div grad psi. Gradient and Laplacian have isotropic leading
// errors.
struct Derivatives {
  double p[DIM];
  double m[DIM][DIM];
  double laplacian;
};

template <int N>
[[gnu::always_inline]] inline void derivatives(const double* f, Derivatives& d) {
  using S = Shape<N>;
  constexpr double NEAR = DIM == 2 ? 4.0 : 2.0, CENTRAL = DIM == 2 ? 20.0 : 24.0;
  double across[DIM] = {}, faces = 0, edges = 0;
  EACH_AXIS(a)
    constexpr int s = S::stride(a);
    const double sum = f[s] + f[-s];
    d.m[a][a] = sum - 2.0 * f[0];
    faces += sum;
  END_AXIS
  EACH_AXIS(a)
    EACH_AXIS(b)
      if constexpr (b > a) {
        constexpr int s = S::stride(a), r = S::stride(b);
        const double pp = f[s + r], pm = f[s - r], mp = f[-s + r], mm = f[-s - r];
        d.m[a][b] = d.m[b][a] = (pp + mm) - (pm + mp);
        edges += (pp + mm) + (pm + mp);
        across[a] += (pp - mm) + (pm - mp);
        across[b] += (pp - mm) - (pm - mp);
      }
    END_AXIS
  END_AXIS
  EACH_AXIS(a)
    constexpr int s = S::stride(a);
    d.p[a] = NEAR * (f[s] - f[-s]) + across[a];
  END_AXIS
  d.laplacian = (NEAR * faces + edges) - CENTRAL * f[0];
}

// The same derivatives along the crystal's axes.
[[gnu::always_inline]] inline void rotate(Derivatives& d, const double (&axes)[DIM][DIM], Derivatives& r) {
  EACH_AXIS(i) d.m[i][i] *= 4.0; END_AXIS
  double half[DIM][DIM];
  EACH_AXIS(i)
    r.p[i] = 0;
    EACH_AXIS(a)
      r.p[i] += axes[i][a] * d.p[a];
      half[i][a] = 0;
      EACH_AXIS(b) half[i][a] += axes[i][b] * d.m[b][a]; END_AXIS
    END_AXIS
  END_AXIS
  EACH_AXIS(i)
    EACH_AXIS(j)
      r.m[i][j] = 0;
      EACH_AXIS(a) r.m[i][j] += half[i][a] * axes[j][a]; END_AXIS
    END_AXIS
  END_AXIS
  EACH_AXIS(i) r.m[i][i] *= 0.25; END_AXIS
  r.laplacian = d.laplacian;
}

// Eq. (1) divided by a_s^2 d phi/d psi: with phi = tanh(psi/sqrt 2) and F the homogeneous vector
// a_s^2 grad psi + |grad psi|^2 a_s d a_s/d(grad psi),
//   a_s^2 D_t psi = div F + sqrt2 phi (1 - a_s^2 |grad psi|^2) - sqrt2 lambda (1 - phi^2) U.
// div F is expanded as Hessian of (a_s^2 p^2 / 2) : grad grad psi. With n = p/|p|, S = sum n_i^4, x_i = n_i^2 - S:
//   div F = (a_s^2 - 16 eps a_s S) lap + 16 eps sum_ij n_i n_j [16 eps x_i x_j + s_i + s_j + 3 a_s delta_ij] M_ij,
//   s_i = -a_s (2 x_i + S): products of n_i n_j only, no trigonometry.
// Where grains meet, -(1+phi)/2 w with the disorder w becomes -w/[sqrt2 (1-phi)]. It grows without limit where phi nears
// 1: see docs/equations.md for why a bound on it changes nothing but the way to the state of rest.
enum class Axes : std::uint8_t { mesh, turned, mixed };

template <int N, Axes KIND>
void phase_rate(const AlloyBlock& blk, const AlloyParameters& par, Scratch<N>& s) {
  using S = Shape<N>;
  const double* psi = blk.psi;
  const double h = 1.0 / blk.dx, h2 = h * h;
  const double b = 1.0 - 3.0 * par.epsilon, e4 = 4.0 * par.epsilon, e16 = 16.0 * par.epsilon;
  const double drive = 4.0 * SQRT2 * par.lambda, tiny = 1e-12 * 144.0 / h2, to_p2 = h2 / 144.0;
  double axes[DIM][DIM];
  for (int i = 0; i < DIM; ++i)
    for (int a = 0; a < DIM; ++a) axes[i][a] = par.axes[i][a];
  const double* t_ = s.t + S::ORIGIN;
  const double* u_ = s.u + S::ORIGIN;
  double* rate_ = s.rate + S::ORIGIN;
  const Array<Array<const double*>> cell_axes = blk.axes;
  const double* disorder = blk.disorder;
  const auto rate = [=](int at) __attribute__((always_inline)) {
    Derivatives d;
    if constexpr (KIND == Axes::mesh) {
      derivatives<N>(psi + at, d);
    } else if constexpr (KIND == Axes::turned) {
      Derivatives lab;
      derivatives<N>(psi + at, lab);
      rotate(lab, axes, d);
    } else {
      Derivatives lab;
      derivatives<N>(psi + at, lab);
      double own[DIM][DIM];
      EACH_AXIS(i)
        EACH_AXIS(a) own[i][a] = cell_axes[i][a][at]; END_AXIS
      END_AXIS
      rotate(lab, own, d);
    }
    double q[DIM], p2 = tiny, p4 = 0;
    EACH_AXIS(i)
      q[i] = d.p[i] * d.p[i];
      p2 += q[i];
      p4 += q[i] * q[i];
    END_AXIS
    const double p22 = p2 * p2, m = b * p22 + e4 * p4;  // a_s |p|^4
    const double inverse = 1.0 / (p2 * m);
    const double ip2 = inverse * m, ip4 = ip2 * ip2;
    const double ratio = inverse * p2 * p22;  // 1 / a_s
    const double a = m * ip4, sum4 = p4 * ip4, as = a * sum4;
    double x[DIM], y[DIM], w[DIM];  // w is -s
    EACH_AXIS(i)
      x[i] = q[i] * ip2 - sum4;
      y[i] = e16 * x[i];
      w[i] = (a + a) * x[i] + as;
    END_AXIS
    double diagonal = 0, beside = 0;
    EACH_AXIS(i)
      diagonal += q[i] * ((y[i] * x[i] + 3.0 * a) - (w[i] + w[i])) * d.m[i][i];
      EACH_AXIS(j)
        if constexpr (j > i) beside += (d.p[i] * d.p[j]) * (y[i] * x[j] - (w[i] + w[j])) * d.m[i][j];
      END_AXIS
    END_AXIS
    const double a2 = a * a;
    const double div =
        h2 * ((1.0 / 6.0) * (a2 - e16 * as) * d.laplacian + (e16 * ip2) * (diagonal + 0.5 * beside));
    const double t = t_[at], phi = 1.0 - 2.0 * t;
    double r = ratio * ratio *
               (div + SQRT2 * phi * (1.0 - std::min(a2 * (to_p2 * p2), STEEPEST)) - drive * (t - t * t) * u_[at]);
    if constexpr (KIND == Axes::mixed) r -= std::min(ratio * ratio * disorder[at] / (2.0 * SQRT2 * t), FASTEST_PULL);
    const bool held = (psi[at] >= PSI_MAX && r > 0) || (psi[at] <= -PSI_MAX && r < 0);
    rate_[at] = held ? 0.0 : r;
  };
  // This is the pass with the most arithmetic: the data that the later ones need come from memory meanwhile.
  around<N>(rate, [&](int piece, int pieces) {
    const double* const later[] = {blk.psi_next, blk.c_next, blk.ahead[0], blk.ahead[1]};
    for (const double* array : later) fetch<N>(array, piece, pieces);
  });
}

template <int N>
void add_noise(const AlloyBlock& blk, const double* psi, Scratch<N>& s) {
  using S = Shape<N>;
  double* rate_ = s.rate + S::ORIGIN;
  amr::for_each_cell(filled(-1), filled(N + 2), [&](const IntVec& cell) {
    int q = 0;
    std::uint64_t key = blk.noise_key;
    for (int a = 0; a < DIM; ++a) {
      q += cell[a] * S::stride(a);
      std::int64_t place = blk.first_cell[a] + cell[a];
      if (blk.period[a] > 0) place = (place + blk.period[a]) % blk.period[a];  // both sides of a face see one number
      key = mix(key ^ static_cast<std::uint64_t>(place));
    }
    if (std::abs(psi[q]) > 4.0) return;
    rate_[q] += blk.noise * (static_cast<double>(key >> 11) * 0x1p-52 - 1.0);  // uniform in [-1, 1)
  });
}

// The printed antitrapping current sees d phi/dt alone: D_t psi - v.grad psi.
template <int N>
void subtract_advection(const AlloyBlock& blk, Scratch<N>& s) {
  using S = Shape<N>;
  const double h = 0.5 / blk.dx;
  const double* psi = blk.psi;
  amr::for_each_cell(filled(-1), filled(N + 2), [&](const IntVec& cell) {
    int q = 0;
    for (int a = 0; a < DIM; ++a) q += cell[a] * S::stride(a);
    double advection = 0;
    for (int a = 0; a < DIM; ++a) {
      const int st = S::stride(a);
      advection += 0.5 * (blk.velocity[a][q] + blk.velocity[a][q + st]) * h * (psi[q + st] - psi[q - st]);
    }
    s.anti[S::ORIGIN + q] = s.rate[S::ORIGIN + q] - advection;
  });
}

// Eq. (2): flux_c = (1-k) { D (1-phi)/2 grad U + [1+(1-k)U] D_t phi n / (2 sqrt 2) } through the high faces along
// AXIS. phi at a face is that of the mean psi, which costs one product: exp(psi_face/sqrt2)^2 = e_left e_right.
template <int N, int AXIS>
void solute_flux(const double* psi, const double* anti, const AlloyParameters& par, double dx, Scratch<N>& s) {
  using S = Shape<N>;
  constexpr int A = S::stride(AXIS);
  const double h = 1.0 / dx, k1 = 1.0 - par.k;
  const double diffusion = k1 * par.diffusivity * h, offset = solid_offset();
  // D_t phi = sqrt2 (1-phi^2)/2 D_t psi and (1-phi^2) = 4 r (1-r); psi's rate is averaged from two cells.
  const double trapping = par.antitrapping == Antitrapping::none ? 0.0 : k1 / (2.0 * SQRT2) * 4.0 / SQRT2 * 0.5;
  const double* e_ = s.e + S::ORIGIN;
  const double* u_ = s.u + S::ORIGIN;
  double* flux_ = s.flux[AXIS] + S::ORIGIN;
  faces<N, AXIS>([=](int q) __attribute__((always_inline)) {
    const double dn = psi[q + A] - psi[q];
    double tangential = 0;
    EACH_AXIS(b)
      if constexpr (b != AXIS) {
        constexpr int B = S::stride(b);
        const double dt = (psi[q + B] - psi[q - B]) + (psi[q + A + B] - psi[q + A - B]);
        tangential += dt * dt;
      }
    END_AXIS
    const double normal = dn * fast_rsqrt((dn * dn + 1e-24) + 0.0625 * tangential);
    const double r = 1.0 / (1.0 + e_[q] * e_[q + A]);
    const double enrichment = 1.0 + 0.5 * k1 * (u_[q] + u_[q + A]);
    flux_[q] = diffusion * (r - offset) * (u_[q + A] - u_[q]) +
               (trapping * (r - r * r)) * ((anti[q] + anti[q + A]) * enrichment) * normal;
  });
}

template <int N>
void update(const AlloyBlock& blk, const Stage& stage, bool phase, const Scratch<N>& s) {
  using S = Shape<N>;
  const double w = stage.weight / blk.dx, nu = stage.nu;
  amr::for_each_row(filled(N), [&](const IntVec& row) {
    int q0 = 0;
    for (int a = 1; a < DIM; ++a) q0 += row[a] * S::stride(a);
    const double* flux[DIM];
    for (int a = 0; a < DIM; ++a) flux[a] = s.flux[a] + S::ORIGIN + q0;
    const double* c = blk.c + q0;
    double* c_next = blk.c_next + q0;
#pragma omp simd
    for (int i = 0; i < N; ++i) {
      double sum = flux[0][i] - flux[0][i - 1];
      for (int a = 1; a < DIM; ++a) sum += flux[a][i] - flux[a][i - S::stride(a)];
      c_next[i] = (c[i] + nu * (c_next[i] - c[i])) + w * sum;
    }
    if (!phase) return;
    const double* psi = blk.psi + q0;
    const double* rate = s.rate + S::ORIGIN + q0;
    double* psi_next = blk.psi_next + q0;
#pragma omp simd
    for (int i = 0; i < N; ++i) {
      const double p = (psi[i] + nu * (psi_next[i] - psi[i])) + stage.weight * rate[i];
      psi_next[i] = std::min(std::max(p, -PSI_MAX), PSI_MAX);
    }
  });
}

template <int N>
void leave_face_fluxes(const AlloyBlock& blk, const Scratch<N>& s) {
  using S = Shape<N>;
  for (int face = 0; face < FACES; ++face) {
    double* out = blk.face_flux[static_cast<std::size_t>(face)];
    if (out == nullptr) continue;
    const int axis = face_axis(face);
    IntVec lo{}, size = filled(N);
    lo[axis] = face_is_high(face) ? N - 1 : -1;
    size[axis] = 1;
    amr::for_each_cell(lo, size, [&](const IntVec& c) {
      int q = S::ORIGIN;
      for (int a = 0; a < DIM; ++a) q += c[a] * S::stride(a);
      *out++ = s.flux[axis][q];
    });
  }
}

template <int N>
void fill_bulk_phase(const AlloyBlock& blk, double value) {
  amr::for_each_row(filled(N), [&](const IntVec& row) {
    int q0 = 0;
    for (int a = 1; a < DIM; ++a) q0 += row[a] * Shape<N>::stride(a);
    std::fill_n(blk.psi_next + q0, N, value);
  });
}

// Bulk liquid: phi = -1, so what is left is plain diffusion of c. The coefficient is the one that solute_flux finds
// between two such cells, so that both sides of a face agree.
template <int N>
void liquid_fluxes(const AlloyBlock& blk, const AlloyParameters& par, Scratch<N>& s) {
  using S = Shape<N>;
  const double e = fast_exp(-PSI_MAX / SQRT2), e2 = e * e;
  const double coefficient =
      par.diffusivity * (1.0 / (1.0 + e2) - solid_offset()) * (1.0 + e2) / (1.0 + par.k * e2) / blk.dx;
  const double* c = blk.c;
  for (int a = 0; a < DIM; ++a) {
    const int A = S::stride(a);
    double* flux = s.flux[a] + S::ORIGIN;
    const int first = -A, last = S::index(N - 1, N - 1, N - 1);
#pragma omp simd
    for (int q = first; q <= last; ++q) flux[q] = coefficient * (c[q + A] - c[q]);
  }
}

template <int N>
void clear_fluxes(Scratch<N>& s) {
  for (int a = 0; a < DIM; ++a) std::fill_n(s.flux[a], Shape<N>::SIZE, 0.0);
}

template <int N>
void rates(const AlloyBlock& blk, const AlloyParameters& par, Scratch<N>& s) {
  primitives<N>(blk.psi, blk.c, par.k, s);
  if (blk.disorder != nullptr) {
    phase_rate<N, Axes::mixed>(blk, par, s);
  } else if (par.rotated) {
    phase_rate<N, Axes::turned>(blk, par, s);
  } else {
    phase_rate<N, Axes::mesh>(blk, par, s);
  }
  if (blk.noise > 0) add_noise<N>(blk, blk.psi, s);
}

template <int N>
void advance(const AlloyBlock& blk, BlockKind kind, const AlloyParameters& par, const Stage& stage) {
  Scratch<N>& s = scratch<N>();
  if (kind == BlockKind::solid) {
    clear_fluxes<N>(s);
    fill_bulk_phase<N>(blk, PSI_MAX);
  } else if (kind == BlockKind::liquid) {
    liquid_fluxes<N>(blk, par, s);
    fill_bulk_phase<N>(blk, -PSI_MAX);
  } else {
    rates<N>(blk, par, s);
    const double* anti = s.rate + Shape<N>::ORIGIN;
    if (par.antitrapping == Antitrapping::eulerian && blk.velocity[0] != nullptr) {
      subtract_advection<N>(blk, s);
      anti = s.anti + Shape<N>::ORIGIN;
    }
    solute_flux<N, 0>(blk.psi, anti, par, blk.dx, s);
    solute_flux<N, 1>(blk.psi, anti, par, blk.dx, s);
    if constexpr (DIM == 3) solute_flux<N, DIM - 1>(blk.psi, anti, par, blk.dx, s);
  }
  update<N>(blk, stage, kind == BlockKind::interface, s);
  leave_face_fluxes<N>(blk, s);
}

template <int N>
void interior_rate(const AlloyBlock& blk, const AlloyParameters& par, std::span<double> out) {
  Scratch<N>& s = scratch<N>();
  rates<N>(blk, par, s);
  std::size_t i = 0;
  amr::for_each_cell({}, filled(N), [&](const IntVec& c) {
    int q = Shape<N>::ORIGIN;
    for (int a = 0; a < DIM; ++a) q += c[a] * Shape<N>::stride(a);
    out[i++] = s.rate[q];
  });
}

template <class F>
void dispatch(int n, F&& f) {
  if (n == 8) return f(std::integral_constant<int, 8>{});
  if (n == 16) return f(std::integral_constant<int, 16>{});
  if (n == 32) return f(std::integral_constant<int, 32>{});
}

}  // namespace

BlockKind classify(const double* psi, int n) {
  int size = 1, origin = 0;
  for (int a = 0; a < DIM; ++a) {
    origin += GHOSTS * size;
    size *= n + 2 * GHOSTS;
  }
  const double* p = psi - origin;
  const double bound = p[0];
  if (bound != PSI_MAX && bound != -PSI_MAX) return BlockKind::interface;
  constexpr int AT_ONCE = 64;  // no branch in between, so that it costs a stream over the block
  for (int first = 0; first < size; first += AT_ONCE) {
    std::uint64_t other_bits = 0;
    for (int q = first; q < std::min(first + AT_ONCE, size); ++q)
      other_bits |= std::bit_cast<std::uint64_t>(p[q]) ^ std::bit_cast<std::uint64_t>(bound);
    if (other_bits != 0) return BlockKind::interface;
  }
  return bound > 0 ? BlockKind::solid : BlockKind::liquid;
}

void advance_alloy(const AlloyBlock& block, BlockKind kind, const AlloyParameters& p, const Stage& stage, int n) {
  dispatch(n, [&](auto size) { advance<decltype(size)::value>(block, kind, p, stage); });
}

void psi_rate(const AlloyBlock& block, const AlloyParameters& p, int n, std::span<double> rate) {
  dispatch(n, [&](auto size) { interior_rate<decltype(size)::value>(block, p, rate); });
}

}  // namespace dendrift::physics

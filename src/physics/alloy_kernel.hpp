/// \file
/// The fused update of phase and solute on one block: equations (1) to (3) of the paper, in the variables
/// psi (phi = tanh(psi/sqrt 2)) and c. See docs/equations.md for the derivation and docs/verification.md for
/// what the change of variable buys. Lengths in W0, times in tau0, c in units of c_l.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <span>

#include "amr/dim.hpp"

namespace dendrift::physics {

/// Beyond |psi| = PSI_MAX a cell counts as bulk: 1 - |phi| = 1e-12 there. psi is held at this bound.
inline constexpr double PSI_MAX = 20.0;
inline constexpr double SQRT2 = 1.4142135623730951;

/// e^x for |x| < 700, to 2 units in the last place; branch-free, so that loops over it vectorise and every lane
/// gives the same bits.
inline double fast_exp(double x) {
  constexpr double LOG2E = 1.4426950408889634, LN2_HI = 0.6931471803691238, LN2_LO = 1.9082149292705877e-10;
  constexpr double SHIFT = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to the nearest integer
  const double t = x * LOG2E + SHIFT;
  const double n = t - SHIFT;
  const double r = (x - n * LN2_HI) - n * LN2_LO;
  double p = 1.0 / 479001600.0;
  p = p * r + 1.0 / 39916800.0;
  p = p * r + 1.0 / 3628800.0;
  p = p * r + 1.0 / 362880.0;
  p = p * r + 1.0 / 40320.0;
  p = p * r + 1.0 / 5040.0;
  p = p * r + 1.0 / 720.0;
  p = p * r + 1.0 / 120.0;
  p = p * r + 1.0 / 24.0;
  p = p * r + 1.0 / 6.0;
  p = p * r + 0.5;
  p = p * r + 1.0;
  p = p * r + 1.0;
  const auto bits = std::bit_cast<std::uint64_t>(t) + 1023U;  // the low bits of t hold n
  return p * std::bit_cast<double>(bits << 52);
}

/// 1/sqrt(x) to a relative error of 3e-11, which is ample for a direction; x > 1e-300.
inline double fast_rsqrt(double x) {
  double y = std::bit_cast<double>(0x5fe6eb50c7b537a9U - (std::bit_cast<std::uint64_t>(x) >> 1));
  const double h = 0.5 * x;
  y *= 1.5 - h * y * y;
  y *= 1.5 - h * y * y;
  y *= 1.5 - h * y * y;
  return y;
}

inline double phi_of_psi(double psi) {
  const double e = fast_exp(psi / SQRT2);
  return 1.0 - 2.0 / (1.0 + e * e);
}
/// c / c_l of U at a given phi: [1+k-(1-k)phi]/2 [1+(1-k)U].
inline double c_of_u(double u, double phi, double k) { return 0.5 * (1 + k - (1 - k) * phi) * (1 + (1 - k) * u); }
inline double u_of_c(double c, double phi, double k) { return (2 * c / (1 + k - (1 - k) * phi) - 1) / (1 - k); }

enum class Antitrapping : std::uint8_t { material, eulerian, none };

struct AlloyParameters {
  double k = 0.14;
  double lambda = 8.839;
  double diffusivity = 5.5394;  ///< D tau0 / W0^2
  double epsilon = 0.05;        ///< eps4
  Array<RealVec> axes{};        ///< row i: crystal axis i in the frame of the mesh; unless a block has its own for each cell
  bool rotated = false;         ///< axes differ from those of the mesh
  Antitrapping antitrapping = Antitrapping::material;
};

/// One stage of a Runge-Kutta-Legendre step: new = old + nu (before - old) + weight * rate(old).
struct Stage {
  double nu = 0;
  double weight = 0;  ///< includes dt
};

/// Arrays of one block, each pointing at cell (0,0[,0]) of an n^DIM block with two ghost layers.
struct AlloyBlock {
  const double* psi = nullptr;
  const double* c = nullptr;
  double* psi_next = nullptr;  ///< in: the stage before `psi`; out: the next stage (interior)
  double* c_next = nullptr;
  std::array<const double*, DIM> velocity{};  ///< face velocities, or null: only the printed antitrapping reads them
  std::array<double*, FACES> face_flux{};     ///< where to leave the solute flux through a face, or null
  std::array<const double*, 2> ahead{};        ///< what the next call reads (psi and c), or null: fetched meanwhile
  /// Component a of crystal axis i cell by cell, with one layer of ghosts; null: AlloyParameters::axes.
  Array<Array<const double*>> axes{};
  const double* disorder = nullptr;  ///< with axes: s |grad alpha| + e^2/2 |grad alpha|^2 of eq. (1), as they
  double dx = 1;
  double noise = 0;                ///< amplitude of the random rate of psi, 0: none
  std::uint64_t noise_key = 0;     ///< the same for all stages of a step
  Array<std::int64_t> first_cell{};  ///< index of cell 0 on its level
  Array<std::int64_t> period{};      ///< cells after which the mesh repeats along an axis, 0: never
};

enum class BlockKind : std::uint8_t { liquid, solid, interface };

/// Largest rate at which disorder pulls psi down, W0/tau0. Where the pull of eq. (1) is stronger, 1 - phi is far below its
/// value at rest.
inline constexpr double FASTEST_PULL = 8.0;

/// Whether psi lies at one bound everywhere in the block and its ghosts, so that the cheaper updates are exact.
BlockKind classify(const double* psi, int n);

/// Advances phase and solute of one block by one stage. n is 8, 16 or 32.
void advance_alloy(const AlloyBlock& block, BlockKind kind, const AlloyParameters& p, const Stage& stage, int n);

/// Rate of psi in the interior of a block (size n^DIM, packed, x fastest): the right-hand side of (1) over
/// a_s^2 and d phi/d psi. For diagnostics and tests.
void psi_rate(const AlloyBlock& block, const AlloyParameters& p, int n, std::span<double> rate);

}  // namespace dendrift::physics

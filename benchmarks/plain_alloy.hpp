/// \file
/// The yardstick: one uniform grid in one big array, advanced by the plain loop that one would write for it.
/// The same scheme as physics::advance_alloy, to round-off, without blocks: every intermediate is computed once a
/// cell, in a sweep over rows that holds the few rows (3D: planes) still needed in cache.
#pragma once

#include <cstddef>
#include <memory>

#include "physics/alloy_kernel.hpp"

namespace dendrift::bench {

/// CELLS^DIM cells (a multiple of 8) inside two layers of ghosts. Crystal axes along the grid, material
/// antitrapping, no noise.
class PlainAlloy {
 public:
  PlainAlloy(int cells, double dx);

  int cells() const { return n_; }
  /// Place of a cell in the arrays; ghosts have indices -2, -1, n and n+1.
  std::ptrdiff_t offset(const IntVec& cell) const;
  double* psi() { return psi_.get(); }
  double* c() { return c_.get(); }
  double* psi_next() { return psi_next_.get(); }  ///< before a stage: the stage before `psi`
  double* c_next() { return c_next_.get(); }

  void fill_ghosts();  ///< of psi and c: mirror images
  void advance(const physics::AlloyParameters& p, const physics::Stage& stage);
  void swap();         ///< next becomes current

 private:
  struct Free {
    void operator()(double* p) const;
  };
  using Array = std::unique_ptr<double[], Free>;
  static Array allocate(std::ptrdiff_t doubles);
  void mirror(double* a) const;

  int n_;
  double dx_;
  std::ptrdiff_t row_, slab_;  // doubles in a row, and in a row (2D) or plane (3D) across the last axis
  Array psi_, c_, psi_next_, c_next_;
  Array e_[2], u_[2], rate_[2];                  // of two slabs: exp(psi/sqrt2), U, D_t psi
  Array t_, flux_x_, flux_y_[2], flux_across_[2];  // rows; flux_across_ a slab: through its low and high side
};

}  // namespace dendrift::bench

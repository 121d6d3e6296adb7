/// \file
/// (sigma + extra) x - div(beta grad x) = f for one unknown in cells, on all levels of the tree at once.
#pragma once

#include <array>
#include <memory>
#include <vector>

#include "amr/hierarchy.hpp"
#include "amr/hypre.hpp"
#include "amr/krylov.hpp"
#include "amr/multigrid.hpp"

namespace dendrift::amr {

enum class ScalarMethod : std::uint8_t { multigrid, hypre };

struct ScalarOptions {
  ScalarMethod method = ScalarMethod::multigrid;
  double tolerance = 1e-10;  ///< true residual over the right-hand side, in the 2-norm and in the largest entry
  int max_iterations = 100;
  int directions = 2;        ///< of the Krylov method
  MultigridOptions cycle{};
};

struct ScalarResult {
  int iterations = 0;
  bool converged = false;
  /// Of b - A x computed anew at the end, over that of b: 2-norm weighted with volumes, and largest entry.
  double residual = 0, largest = 0;
  /// What the rounding of x alone may leave of either: less than that is not asked for.
  double rounding = 0;
};

/// Solver for one mesh; build it anew when the mesh changes. What flows out of a cell through the side of a coarse leaf
/// flows into the finer cells beyond. Where nothing fixes the constant (sigma = 0, sides even or periodic), the means of f
/// and of the solution are taken off.
///
/// Generalised conjugate residuals round one multigrid cycle; or hypre, on a matrix put together cell by cell.
class ScalarSolver {
 public:
  ScalarSolver(const Mesh& mesh, const std::array<MirrorRule, FACES>& sides, const ScalarOptions& options = {});

  Hierarchy& hierarchy() { return hierarchy_; }
  HierarchyField& solution() { return state_; }  ///< the first guess, then the solution, ghosts filled
  HierarchyField& rhs() { return rhs_; }         ///< f in the leaves
  /// beta > 0 on the faces 0 to n of the leaves, component a along axis a. Where levels meet that of finer faces counts.
  HierarchyField& beta() { return beta_; }
  /// >= 0 in the leaves: added to sigma cell by cell by prepare_with_extra.
  HierarchyField& extra() { return extra_; }

  /// Before the first solution, and when sigma or beta have changed.
  void prepare(double sigma);                 ///< with beta()
  void prepare_with_extra(double sigma);      ///< with beta() and extra()
  void prepare(double sigma, double beta);    ///< the same everywhere
  ScalarResult solve();

 private:
  using Vector = Gcr::Vector;
  void prepare_beta(double sigma);
  void prepare_links(double sigma, const Links& links);
  double zeroth(int g, int i, std::ptrdiff_t q) const { return with_extra_ ? sigma_ + extra_.at(g, i, 0)[q] : sigma_; }
  void weigh();
  void spread_beta();
  void fill(HierarchyField& f, bool homogeneous);
  /// A x, or rhs - A x if `rhs` is given.
  void apply(HierarchyField& x, bool homogeneous, const HierarchyField* rhs, Vector& y);
  void pack(const HierarchyField& f, Vector& v) const;
  void unpack(const Vector& v, HierarchyField& f) const;
  void remove_mean(Vector& v) const;
  double largest(const Vector& v) const;
  double rounding(const Vector& x) const;
  void assemble();
  int solve_by_hypre(Vector& x, const Vector& r);

  ScalarOptions options_;
  const Mesh& mesh_;
  Hierarchy hierarchy_;
  HierarchyField state_, rhs_, beta_, extra_;
  Multigrid cycle_;
  Gcr gcr_;
  Pieces pieces_, volumes_;  // weighted for the Krylov method, and with volumes alone
  Array<int> kappa_{};
  double sigma_ = 0, factor_ = 1;
  bool floating_ = true;  // the constant is free
  bool with_extra_ = false;
  std::unique_ptr<HypreSolver> hypre_;
};

}  // namespace dendrift::amr

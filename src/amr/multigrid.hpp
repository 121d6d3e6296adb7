/// \file
/// One V-cycle for several scalar problems at once on the hierarchy: sigma x - sum_b d_b(kappa_b d_b x) = r, each
/// component with its own centring. Used as a preconditioner, so sides count as homogeneous.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "amr/hierarchy.hpp"
#include "amr/hypre.hpp"
#include "amr/sparse_solver.hpp"

namespace dendrift::amr {

/// Where a component finds its coefficients: kappa_b between a place and the one below it along b is
/// factor * coefficients.at(field)[place + shift]; field -1: the constant `factor`.
struct Links {
  double sigma = 0;
  struct Along {
    int field = -1;
    int below = 0;  ///< 1: the coefficient of place i - 1 along b belongs to the link below i (cells under faces)
    double factor = 1;
  };
  Array<Along> along{};
  /// Component a of a vector whose components are all here and carried by faces: each link across a, of the difference
  /// d_b x_a, acts on d_b x_a + d_a x_b instead, as the symmetric viscous stress does.
  bool coupled = false;
};

enum class BottomSolver : std::uint8_t { direct, hypre };

struct MultigridOptions {
  double lowest = 6;  ///< smoothing acts on eigenvalues from 2/lowest to 2 of the diagonally scaled operator
  BottomSolver bottom = BottomSolver::direct;
};

/// Chebyshev steps, two or three of them in one pass over a block from two layers of ghosts, so that memory is read
/// once where steps and exchanges by themselves read it several times. One component in cells: two steps before and
/// after the coarser grid, and fluxes of corrections match where levels meet. The components of a vector on faces:
/// three, and ghosts beside coarser leaves follow the corrections that they are interpolated from.
class Multigrid {
 public:
  /// Coefficients (of places below 0, and along 0 .. n) need two layers of ghosts on all grids.
  Multigrid(Hierarchy& hierarchy, std::vector<Component> components, const HierarchyField& coefficients,
            MultigridOptions options = {});

  /// Call before the first cycle, and when the coefficients or sigma have changed. `drag`: added to sigma place by place,
  /// components as x; it has to live as long as cycles are asked for.
  void prepare(std::vector<Links> links, const HierarchyField* drag = nullptr);
  /// Right-hand side on the leaves (the rest is overwritten); zero where nothing is unknown.
  HierarchyField& rhs() { return rhs_; }
  /// One cycle from zero; the result is in solution(), on the leaves of all grids.
  void cycle();
  HierarchyField& solution() { return x_; }

 private:
  struct Step {
    double weight = 0, momentum = 0;
  };
  static constexpr std::size_t MOST_STEPS = 3;
  std::array<Step, MOST_STEPS> chebyshev() const;
  void descend_in_pairs(int g);
  void ascend_in_pairs(int g);
  void match_border(int g);
  void descend_in_threes(int g);
  void ascend_in_threes(int g);
  void meet_coarser(int g);
  void correct_border(int g);
  void close_sides(int g, int i, int c, const double* held, double* x) const;
  Range own(int g, int i, int c) const;
  Array<ArrayRef<const double>> residual_round(int g, int i) const;
  void prepare_shares();
  void prepare_bottom();
  void solve_bottom();
  static bool on_free_side(const Grid::Node& n, const Component& c, const IntVec& q, int cells);
  template <class F>
  void for_bottom(F&& f) const;
  /// f(places of a row of unknowns, its length) for one component of one node.
  template <class F>
  void rows(int g, const Range& box, F&& f) const;
  template <class F>
  void with_operator(const HierarchyField& x, int g, int i, int c, F&& f) const;

  Hierarchy& h_;
  const HierarchyField& coefficients_;
  std::vector<Links> links_;
  MultigridOptions options_;
  bool scalar_;  // one component in cells
  HierarchyField x_, rhs_, step_, inverse_;  // step_ in pairs: 0 but for ghosts beside finer nodes
  HierarchyField shares_;  // in pairs, where a coefficient varies: see Hierarchy::prolong_add_shared
  const HierarchyField* drag_ = nullptr;
  std::vector<double> no_drag_;  // zeros for any block
  SparseSolver bottom_;
  std::unique_ptr<HypreSolver> hypre_bottom_;
  int bottom_size_ = 0;
  std::vector<double> bottom_values_, bottom_weights_;
};

}  // namespace dendrift::amr

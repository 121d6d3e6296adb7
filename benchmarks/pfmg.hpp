/// \file
/// hypre's geometric multigrid on one uniform grid in one array: what composite solvers are measured against.
#pragma once

#include <functional>
#include <memory>
#include <vector>

#include "amr/dim.hpp"

namespace dendrift::bench {

/// -div(beta grad x) = f on n^DIM cells of the unit box, x = 0 on its sides, by PFMG alone or as preconditioner of CG.
class Pfmg {
 public:
  static bool available();
  /// beta(place) on faces.
  Pfmg(int n, const std::function<double(const RealVec&)>& beta, bool conjugate_gradients);
  ~Pfmg();
  /// f and x: all cells, x fastest. From zero to a residual of `tolerance` |f| in the 2-norm. Returns the iterations.
  int solve(const std::vector<double>& f, std::vector<double>& x, double tolerance);

 private:
  struct Handles;
  std::unique_ptr<Handles> h_;
};

}  // namespace dendrift::bench

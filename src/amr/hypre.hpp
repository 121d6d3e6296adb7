/// \file
/// hypre's solvers for sparse systems whose rows are spread over ranks: another way to the same solution.
#pragma once

#include <mpi.h>

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

namespace dendrift::amr {

/// A Krylov method with one BoomerAMG cycle as its preconditioner. Throws std::runtime_error where the build has no hypre.
class HypreSolver {
 public:
  enum class Krylov : std::uint8_t { conjugate_gradients, gmres };
  struct Entry {
    std::int64_t row, column;
    double value;
  };
  static bool available();

  /// This rank has the rows from `first` to `first + size`. Entries of one place are added, and may belong to rows of
  /// other ranks. Collective.
  HypreSolver(MPI_Comm comm, std::int64_t first, std::int64_t size, const std::vector<Entry>& entries, Krylov method);
  ~HypreSolver();
  HypreSolver(const HypreSolver&) = delete;
  HypreSolver& operator=(const HypreSolver&) = delete;

  /// x: the guess, then the solution, to a residual of `tolerance` times the norm of b. Returns the iterations. Collective.
  int solve(std::span<const double> b, std::span<double> x, double tolerance, int max_iterations);

 private:
  struct Handles;
  std::unique_ptr<Handles> h_;
};

}  // namespace dendrift::amr

/// \file
/// Direct solution of small symmetric systems: the bottom of multigrid.
#pragma once

#include <memory>
#include <span>
#include <vector>

namespace dendrift::amr {

/// LDL^T of a sparse symmetric matrix, on one rank. Rows that leave a system singular (a constant that nothing fixes)
/// get a diagonal larger by 1e-9 of itself.
class SparseSolver {
 public:
  struct Entry {
    int row, column;
    double value;
  };

  static constexpr double LIFT = 1e-9;

  SparseSolver();
  ~SparseSolver();
  SparseSolver(SparseSolver&&) noexcept;
  SparseSolver& operator=(SparseSolver&&) noexcept;

  /// Entries of one place are added. The pattern may only change with the size.
  void factorize(int size, const std::vector<Entry>& entries);
  /// In place. Throws std::runtime_error if there is no factorization.
  void solve(std::span<double> x) const;
  int size() const { return size_; }

 private:
  struct Factors;
  int size_ = 0;
  std::unique_ptr<Factors> factors_;
};

}  // namespace dendrift::amr

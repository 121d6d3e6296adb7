#include "amr/sparse_solver.hpp"

#include <gtest/gtest.h>

namespace dendrift::test {
namespace {

using amr::SparseSolver;

// -u'' on a ring or between walls, entries of one place given in parts.
std::vector<SparseSolver::Entry> chain(int n, bool ring) {
  std::vector<SparseSolver::Entry> list;
  for (int i = 0; i < n; ++i) {
    list.push_back({i, i, 1.5});
    list.push_back({i, i, 0.5});
    for (const int j : {i - 1, i + 1})
      if (ring || (j >= 0 && j < n)) list.push_back({i, (j + n) % n, -1});
  }
  return list;
}

TEST(SparseSolver, SolvesAndTakesNewNumbers) {
  SparseSolver solver;
  solver.factorize(5, chain(5, false));
  std::vector<double> x{0, 0, 1, 0, 0};
  solver.solve(x);
  const double want[] = {0.5, 1, 1.5, 1, 0.5};
  for (int i = 0; i < 5; ++i) EXPECT_NEAR(x[static_cast<std::size_t>(i)], want[i], 1e-7);
  auto twice = chain(5, false);
  for (auto& e : twice) e.value *= 2;
  solver.factorize(5, twice);
  x = {0, 0, 1, 0, 0};
  solver.solve(x);
  EXPECT_NEAR(x[2], 0.75, 1e-7);
}

TEST(SparseSolver, ConstantThatNothingFixes) {
  SparseSolver solver;
  solver.factorize(6, chain(6, true));
  std::vector<double> x{1, 0, 0, -1, 0, 0};
  solver.solve(x);
  EXPECT_NEAR(x[0] - x[3], 1.5, 1e-6);  // half the ring of three links either way
}

TEST(SparseSolver, RefusesAnotherSize) {
  SparseSolver solver;
  solver.factorize(5, chain(5, false));
  std::vector<double> x(4);
  EXPECT_THROW(solver.solve(x), std::runtime_error);
}

}  // namespace
}  // namespace dendrift::test

// sigma x - div(beta grad x) = f on all levels at once, against solutions that are known and against hypre.
#include "amr/scalar_solver.hpp"

#include <gtest/gtest.h>

#include "support/mesh_fixture.hpp"

namespace dendrift::test {
namespace {

using amr::MirrorRule;
using amr::ScalarMethod;
using amr::ScalarOptions;
using amr::ScalarResult;
using amr::ScalarSolver;

constexpr int N = 8;
using Sides = std::array<MirrorRule, FACES>;

Sides all_sides(bool odd) {
  Sides s{};
  for (MirrorRule& r : s) r.odd = odd;
  return s;
}

// The unit box of roots^DIM blocks, its middle refined `levels` times.
amr::Mesh box(int roots, int levels, bool periodic, MPI_Comm comm = MPI_COMM_SELF, bool scatter = false) {
  amr::MeshShape s;
  s.root_blocks = filled(roots);
  s.max_level = levels;
  s.block_cells = N;
  s.root_dx = 1.0 / (roots * N);
  s.sides.fill(periodic ? amr::Side::periodic : amr::Side::wall);
  amr::Mesh mesh(s, {}, comm);
  amr::Tree tree = mesh.tree();
  for (int level = 0; level < levels; ++level) {
    std::vector<std::int8_t> change(static_cast<std::size_t>(tree.size()));
    for (int i = 0; i < tree.size(); ++i) {
      const amr::Block b = mesh.describe(tree.leaf(i));
      bool inside = b.index.level == level;
      for (int a = 0; a < DIM; ++a) {
        const double middle = b.lo[a] + 0.5 * N * b.dx;
        inside = inside && middle > 0.25 + 0.125 * level && middle < 0.75 - 0.125 * level;
      }
      change[static_cast<std::size_t>(i)] = inside ? 1 : 0;
    }
    tree = tree.adapted(change);
  }
  Random random(5);
  const std::vector<int> owners = deal_out(scatter ? Deal::scattered : Deal::curve, tree, ranks_of(comm), random);
  put(mesh, std::move(tree), owners);
  return mesh;
}

template <class F>
void for_places(const amr::Mesh& mesh, amr::Hierarchy& h, int normal, F&& f) {
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = h.place_of_block(b);
    IntVec size = filled(N);
    if (normal >= 0) ++size[normal];
    amr::for_each_cell({}, size, [&](const IntVec& q) {
      RealVec x = cell_centre(mesh.block(b), q);
      if (normal >= 0) x[normal] -= 0.5 * mesh.block(b).dx;
      f(g, i, mesh.layout().offset(q), x, std::pow(mesh.block(b).dx, DIM));
    });
  }
}

template <class F>
void set_rhs(const amr::Mesh& mesh, ScalarSolver& solver, F&& f) {
  for_places(mesh, solver.hierarchy(), -1,
             [&](int g, int i, std::ptrdiff_t o, const RealVec& x, double) { solver.rhs().at(g, i, 0)[o] = f(x); });
}

template <class F>
void set_beta(const amr::Mesh& mesh, ScalarSolver& solver, F&& beta) {
  for (int a = 0; a < DIM; ++a)
    for_places(mesh, solver.hierarchy(), a,
               [&](int g, int i, std::ptrdiff_t o, const RealVec& x, double) { solver.beta().at(g, i, a)[o] = beta(x); });
}

template <class F>
double error(const amr::Mesh& mesh, ScalarSolver& solver, F&& want) {
  double square = 0;
  for_places(mesh, solver.hierarchy(), -1, [&](int g, int i, std::ptrdiff_t o, const RealVec& x, double volume) {
    const double e = solver.solution().at(g, i, 0)[o] - want(x);
    square += e * e * volume;
  });
  return std::sqrt(square);
}

// u and -div[(1 + x) grad u] + 3 u.
double wave(const RealVec& x, double k, bool cosines) {
  double u = 1;
  for (const double c : x) u *= cosines ? std::cos(k * c) : std::sin(k * c);
  return u;
}
double source(const RealVec& x, double k, bool cosines, double sigma) {
  RealVec rest = x;
  double others = 1;
  for (int a = 1; a < DIM; ++a) others *= cosines ? std::cos(k * x[a]) : std::sin(k * x[a]);
  const double slope = k * others * (cosines ? -std::sin(k * x[0]) : std::cos(k * x[0]));
  return sigma * wave(rest, k, cosines) + (1 + x[0]) * DIM * k * k * wave(rest, k, cosines) - slope;
}

TEST(ScalarSolver, OrderTwoAcrossLevels) {
  for (const bool even : {false, true}) {
    std::vector<double> errors;
    for (const int roots : DIM == 2 ? std::vector<int>{4, 8, 16} : std::vector<int>{4, 8}) {
      const amr::Mesh mesh = box(roots, DIM == 2 ? 2 : 1, false);
      ScalarSolver solver(mesh, all_sides(!even));
      set_rhs(mesh, solver, [&](const RealVec& x) { return source(x, M_PI, even, 3); });
      set_beta(mesh, solver, [](const RealVec& x) { return 1 + x[0]; });
      solver.prepare(3);
      const ScalarResult r = solver.solve();
      EXPECT_TRUE(r.converged) << r.residual << " " << r.largest;
      EXPECT_LT(r.iterations, 20);
      EXPECT_LE(r.largest, std::max(1e-10, r.rounding));
      errors.push_back(error(mesh, solver, [&](const RealVec& x) { return wave(x, M_PI, even); }));
    }
    for (std::size_t i = 1; i < errors.size(); ++i)
      EXPECT_GT(std::log2(errors[i - 1] / errors[i]), 1.8) << errors[i - 1] << " " << errors[i];
  }
}

TEST(ScalarSolver, ValuesOnSides) {
  const amr::Mesh mesh = box(4, 1, false);
  Sides sides = all_sides(true);
  for (MirrorRule& s : sides) {  // 2 + x - 3 y, which second order has exactly
    s.value.constant = 2;
    s.value.gradient[0] = 1;
    s.value.gradient[1] = -3;
  }
  ScalarSolver solver(mesh, sides);
  solver.prepare(0, 2.5);
  EXPECT_TRUE(solver.solve().converged);
  EXPECT_LT(error(mesh, solver, [](const RealVec& x) { return 2 + x[0] - 3 * x[1]; }), 1e-9);
}

// sigma that differs from cell to cell, by a factor of 2000 at an edge: u as above, and hypre finds the same.
TEST(ScalarSolver, ZerothOrderTermOfEachCell) {
  const auto extra = [](const RealVec& x) { return x[0] + 0.3 * x[1] > 0.6 ? 2000.0 : 1 + x[1]; };
  std::vector<double> errors;
  for (const int roots : DIM == 2 ? std::vector<int>{4, 8} : std::vector<int>{2, 4}) {
    const amr::Mesh mesh = box(roots, DIM == 2 ? 2 : 1, false);
    for (const ScalarMethod method : {ScalarMethod::multigrid, ScalarMethod::hypre}) {
      if (method == ScalarMethod::hypre && !amr::HypreSolver::available()) continue;
      ScalarOptions o;
      o.method = method;
      ScalarSolver solver(mesh, all_sides(true), o);
      set_rhs(mesh, solver, [&](const RealVec& x) { return source(x, M_PI, false, 3) + extra(x) * wave(x, M_PI, false); });
      set_beta(mesh, solver, [](const RealVec& x) { return 1 + x[0]; });
      for_places(mesh, solver.hierarchy(), -1,
                 [&](int g, int i, std::ptrdiff_t q, const RealVec& x, double) { solver.extra().at(g, i, 0)[q] = extra(x); });
      solver.prepare_with_extra(3);
      const ScalarResult r = solver.solve();
      EXPECT_TRUE(r.converged) << r.residual << " " << r.largest;
      EXPECT_LT(r.iterations, 20);
      errors.push_back(error(mesh, solver, [&](const RealVec& x) { return wave(x, M_PI, false); }));
    }
  }
  EXPECT_LT(errors.back(), 0.35 * errors.front());
  EXPECT_NEAR(errors[0], errors[amr::HypreSolver::available() ? 1 : 0], 1e-7);
}

TEST(ScalarSolver, FreeConstant) {
  for (const bool periodic : {false, true}) {
    const amr::Mesh mesh = box(4, 2, periodic);
    ScalarSolver solver(mesh, all_sides(false));
    const double k = periodic ? 2 * M_PI : M_PI;
    const auto want = [&](const RealVec& x) { return wave(x, k, true); };
    // A mean that cannot be: it is taken off.
    set_rhs(mesh, solver, [&](const RealVec& x) { return DIM * k * k * want(x) + 7; });
    solver.prepare(0, 1);
    const ScalarResult r = solver.solve();
    EXPECT_TRUE(r.converged) << r.residual << " " << r.largest;
    EXPECT_LT(r.iterations, 20);
    EXPECT_LT(error(mesh, solver, want), 0.02);
    double sum = 0;
    for_places(mesh, solver.hierarchy(), -1, [&](int g, int i, std::ptrdiff_t o, const RealVec&, double volume) {
      sum += volume * solver.solution().at(g, i, 0)[o];
    });
    EXPECT_NEAR(sum, 0, 1e-12);
  }
}

double disc(const RealVec& x, double ratio) {
  double square = 0;
  for (const double c : x) square += (c - 0.47) * (c - 0.47);
  return 1 + (ratio - 1) * 0.5 * (1 + std::tanh((0.21 - std::sqrt(square)) * (DIM == 2 ? 64 : 32)));  // some two cells
}

TEST(ScalarSolver, JumpsOfBeta) {
  for (const double ratio : {1e3, 1e6, 1e-6}) {
    const amr::Mesh mesh = box(4, DIM == 2 ? 2 : 1, false);
    ScalarSolver solver(mesh, all_sides(true));
    set_rhs(mesh, solver, [](const RealVec& x) { return std::exp(x[0]) - x[1]; });
    set_beta(mesh, solver, [&](const RealVec& x) { return disc(x, ratio); });
    solver.prepare(0);
    const ScalarResult r = solver.solve();
    EXPECT_TRUE(r.converged) << ratio << ": " << r.residual << " " << r.largest << " " << r.rounding;
    EXPECT_LT(r.iterations, 60) << ratio;
  }
}

// On ranks that own blocks at random: the bits are those of one rank.
TEST(MpiScalarSolver, SameBitsOnAnyRanks) {
  const auto run = [](const amr::Mesh& mesh) {
    auto solver = std::make_unique<ScalarSolver>(mesh, all_sides(true));
    set_rhs(mesh, *solver, [](const RealVec& x) { return std::exp(x[0]) - x[1]; });
    set_beta(mesh, *solver, [](const RealVec& x) { return disc(x, 100); });
    solver->prepare(0);
    EXPECT_TRUE(solver->solve().converged);
    return solver;
  };
  const amr::Mesh mesh = box(4, 2, false, MPI_COMM_WORLD, true), whole = whole_copy(mesh);
  const auto spread = run(mesh), alone = run(whole);
  Tally tally;
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = spread->hierarchy().place_of_block(b);
    const auto [h, k] = alone->hierarchy().place_of_block(whole.local(mesh.block(b).leaf));
    for_interior(mesh.layout(), [&, g = g, i = i, h = h, k = k](const IntVec& q) {
      const std::ptrdiff_t o = mesh.layout().offset(q);
      tally.bits(spread->solution().at(g, i, 0)[o], alone->solution().at(h, k, 0)[o], [&] { return text(q); });
    });
  }
  EXPECT_TRUE(tally.result());
}

TEST(MpiScalarSolver, HypreFindsTheSame) {
  if (!amr::HypreSolver::available()) GTEST_SKIP() << "no hypre in this build";
  for (const int levels : {0, 2})
    for (const bool periodic : {false, true}) {
      const amr::Mesh mesh = box(4, levels, periodic, MPI_COMM_WORLD, true);
      std::vector<std::unique_ptr<ScalarSolver>> solvers;
      for (const ScalarMethod method : {ScalarMethod::multigrid, ScalarMethod::hypre}) {
        ScalarOptions o;
        o.method = method;
        solvers.push_back(std::make_unique<ScalarSolver>(mesh, all_sides(!periodic), o));
        set_rhs(mesh, *solvers.back(), [](const RealVec& x) { return std::sin(2 * M_PI * x[0]) + std::cos(2 * M_PI * x[1]); });
        set_beta(mesh, *solvers.back(), [](const RealVec& x) { return disc(x, 50); });
        solvers.back()->prepare(0);
        const ScalarResult r = solvers.back()->solve();
        EXPECT_TRUE(r.converged) << levels << " " << r.residual << " " << r.largest << " after " << r.iterations;
      }
      double worst = 0, size = 0;
      for_places(mesh, solvers[0]->hierarchy(), -1, [&](int g, int i, std::ptrdiff_t o, const RealVec&, double) {
        const double a = solvers[0]->solution().at(g, i, 0)[o], b = solvers[1]->solution().at(g, i, 0)[o];
        worst = std::max(worst, std::abs(a - b));
        size = std::max(size, std::abs(a));
      });
      EXPECT_LE(worst, 1e-8 * size) << levels << periodic;
    }
}

TEST(Multigrid, HypreAsBottomSolver) {
  if (!amr::HypreSolver::available()) GTEST_SKIP() << "no hypre in this build";
  const amr::Mesh mesh = box(4, 1, false);
  amr::Hierarchy h(mesh);
  const amr::Component cells{-1, all_sides(true)};
  const amr::HierarchyField none(h, {cells});
  std::vector<std::vector<double>> found;
  for (const amr::BottomSolver bottom : {amr::BottomSolver::direct, amr::BottomSolver::hypre}) {
    amr::MultigridOptions o;
    o.bottom = bottom;
    amr::Multigrid cycle(h, {cells}, none, o);
    cycle.prepare({amr::Links{}});
    for_places(mesh, h, -1, [&](int g, int i, std::ptrdiff_t p, const RealVec& x, double) { cycle.rhs().at(g, i, 0)[p] = x[0]; });
    cycle.cycle();
    std::vector<double>& list = found.emplace_back();
    for_places(mesh, h, -1, [&](int g, int i, std::ptrdiff_t p, const RealVec&, double) { list.push_back(cycle.solution().at(g, i, 0)[p]); });
  }
  double size = 0;
  for (const double x : found[0]) size = std::max(size, std::abs(x));
  for (std::size_t i = 0; i < found[0].size(); ++i) EXPECT_NEAR(found[0][i], found[1][i], 1e-9 * size);
}

}  // namespace
}  // namespace dendrift::test

// Whole solutions of elliptic problems: cells and levels of the program beside hypre on one plain grid.
#include <memory>

#include "amr/scalar_solver.hpp"
#include "common.hpp"
#include "pfmg.hpp"
#include "physics/stokes.hpp"

namespace dendrift::bench {

namespace {

constexpr int UNIFORM = DIM == 2 ? 1024 : 64;
constexpr int LEVELS = DIM == 2 ? 4 : 2;
constexpr double RADIUS = 0.2;

double from_centre(const RealVec& x) {
  double square = 0;
  for (const double c : x) square += (c - 0.5) * (c - 0.5);
  return std::sqrt(square);
}

// Least and greatest distance of a block from the centre of the box.
std::array<double, 2> distances(const amr::Block& b, int n) {
  double near = 0, far = 0;
  for (int a = 0; a < DIM; ++a) {
    const double lo = b.lo[a] - 0.5, hi = lo + n * b.dx;
    const double least = lo > 0 ? lo : hi < 0 ? -hi : 0, most = std::max(std::abs(lo), std::abs(hi));
    near += least * least;
    far += most * most;
  }
  return {std::sqrt(near), std::sqrt(far)};
}

// The unit box from one root: `base` cells a side everywhere, then `levels` more round the circle, each in a band half as
// wide as the one before, the last of .01.
amr::Mesh unit_box(int base, int levels, int n) {
  amr::MeshShape s;
  s.root_blocks = filled(1);
  s.block_cells = n;
  s.root_dx = 1.0 / n;
  int everywhere = 0;
  while (n << everywhere < base) ++everywhere;
  s.max_level = everywhere + levels;
  s.sides.fill(amr::Side::wall);
  amr::Mesh mesh(s, {}, MPI_COMM_SELF);
  for (int level = 0; level < s.max_level; ++level) {
    const double band = 0.01 * (1 << (s.max_level - 1 - level));
    std::vector<std::int8_t> change(static_cast<std::size_t>(mesh.tree().size()));
    for (int i = 0; i < mesh.tree().size(); ++i) {
      const amr::Block b = mesh.describe(mesh.tree().leaf(i));
      const auto [near, far] = distances(b, n);
      const bool round_circle = near < RADIUS + band && far > RADIUS - band;
      change[static_cast<std::size_t>(i)] = b.index.level == level && (level < everywhere || round_circle) ? 1 : 0;
    }
    amr::Tree tree = mesh.tree().adapted(change);
    for (const amr::Block& b : mesh.blocks()) mesh.release_slot(b.slot);
    const std::vector<int> owners(static_cast<std::size_t>(tree.size()), 0), fresh(owners.size(), -1);
    mesh.install(std::move(tree), owners, fresh);
  }
  return mesh;
}

// 1 outside the circle, 1000 in it, over 4 cells.
struct Jump {
  double ratio, dx;
  double operator()(const RealVec& x) const {
    return 1 + (ratio - 1) * 0.5 * (1 + std::tanh((RADIUS - from_centre(x)) / (2 * dx)));
  }
  double slope(double r) const {
    const double c = std::cosh((RADIUS - r) / (2 * dx));
    return c > 1e100 ? 0.0 : -(ratio - 1) / (4 * dx * c * c);
  }
};

// -div(beta grad u) for the u of a few waves: with a source of order 1 instead, the rounding of u alone would leave more
// than 1e-10 of it where beta is 1000.
double source(const RealVec& x, const Jump& beta) {
  double f = 0;
  for (const double k : {1.0, 3.0, 8.0}) {
    RealVec wave{}, slope{};
    for (int a = 0; a < DIM; ++a) {
      const double m = M_PI * (k + a);
      wave[a] = std::sin(m * x[a]);
      slope[a] = m * std::cos(m * x[a]);
    }
    double u = 1 / k, squares = 0;
    for (int a = 0; a < DIM; ++a) {
      u *= wave[a];
      squares += M_PI * M_PI * (k + a) * (k + a);
    }
    f += beta(x) * squares * u;
    const double r = from_centre(x);
    for (int a = 0; a < DIM; ++a) {
      double d = slope[a] / k;
      for (int b = 0; b < DIM; ++b)
        if (b != a) d *= wave[b];
      f -= beta.slope(r) * (r > 0 ? (x[a] - 0.5) / r : 0.0) * d;
    }
  }
  return f;
}

template <class F>
void for_each_place(const amr::Mesh& mesh, amr::Hierarchy& h, int normal, F&& f) {
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = h.place_of_block(b);
    IntVec size = filled(mesh.layout().n);
    if (normal >= 0) ++size[normal];
    amr::for_each_cell({}, size, [&](const IntVec& q) {
      RealVec x{};
      for (int a = 0; a < DIM; ++a) x[a] = mesh.block(b).lo[a] + (q[a] + (a == normal ? 0.0 : 0.5)) * mesh.block(b).dx;
      f(g, i, mesh.layout().offset(q), x, b, q);
    });
  }
}

double cells_of(const amr::Mesh& mesh) { return static_cast<double>(mesh.size() * volume(filled(mesh.layout().n))); }

void report(benchmark::State& state, const std::vector<double>& us, double iterations, double residual, double cells) {
  state.counters["us_per_cell"] = median(us);
  state.counters["us_min"] = least(us);
  state.counters["us_max"] = greatest(us);
  state.counters["iterations"] = iterations;
  state.counters["us_per_iteration"] = median(us) / iterations;
  state.counters["residual"] = residual;
  state.counters["cells"] = cells;
}

enum class Beside { nothing, pfmg };

// ratio: of beta.
void scalar(benchmark::State& state, int levels, double ratio, Beside beside) {
  const int n = static_cast<int>(state.range(0)), base = levels > 0 ? (DIM == 2 ? 128 : 32) : UNIFORM;
  const amr::Mesh mesh = unit_box(base, levels, n);
  const Jump jump{ratio, 1.0 / (base << levels)};
  std::array<amr::MirrorRule, FACES> walls{};
  for (amr::MirrorRule& w : walls) w.odd = true;
  amr::ScalarSolver solver(mesh, walls);
  std::vector<double> plain_f(beside == Beside::pfmg ? static_cast<std::size_t>(cells_of(mesh)) : 0), plain_x;
  for_each_place(mesh, solver.hierarchy(), -1, [&](int g, int i, std::ptrdiff_t o, const RealVec& x, int b, const IntVec& q) {
    solver.rhs().at(g, i, 0)[o] = source(x, jump);
    if (plain_f.empty()) return;
    std::size_t place = 0;
    for (int a = DIM - 1; a >= 0; --a)
      place = place * static_cast<std::size_t>(base) + static_cast<std::size_t>(mesh.block(b).index.coord[a] * n + q[a]);
    plain_f[place] = source(x, jump);
  });
  if (ratio == 1) {
    solver.prepare(0, 1);
  } else {
    for (int a = 0; a < DIM; ++a)
      for_each_place(mesh, solver.hierarchy(), a, [&](int g, int i, std::ptrdiff_t o, const RealVec& x, int, const IntVec&) {
        solver.beta().at(g, i, a)[o] = jump(x);
      });
    solver.prepare(0);
  }
  std::unique_ptr<Pfmg> pfmg;
  if (beside == Beside::pfmg && Pfmg::available()) pfmg = std::make_unique<Pfmg>(base, jump, ratio != 1);
  amr::ScalarResult result;
  int plain_iterations = 0;
  const double cells = cells_of(mesh);
  std::vector<double> us, plain_us, ratios;
  const auto ours = [&] {
    const double t = timed([&] {
      for (int g = 0; g < solver.hierarchy().levels(); ++g) solver.solution().clear(g);
      result = solver.solve();
    });
    return 1e6 * t / cells;
  };
  const auto plain = [&] {
    return 1e6 * timed([&] { plain_iterations = pfmg->solve(plain_f, plain_x, 1e-10); }) / cells;
  };
  ours();
  if (pfmg != nullptr) plain();
  for (auto _ : state) {
    const bool plain_first = us.size() % 2 == 1;
    if (pfmg != nullptr && plain_first) plain_us.push_back(plain());
    us.push_back(ours());
    state.SetIterationTime(1e-6 * us.back() * cells);
    if (pfmg != nullptr && !plain_first) plain_us.push_back(plain());
    if (pfmg != nullptr) ratios.push_back(us.back() / plain_us.back());
  }
  if (!result.converged) state.SkipWithError("not converged");
  report(state, us, result.iterations, result.largest, cells);
  if (pfmg == nullptr) return;
  // The same numbers, or the comparison means nothing.
  double worst = 0, size = 0;
  for_each_place(mesh, solver.hierarchy(), -1, [&](int g, int i, std::ptrdiff_t o, const RealVec&, int b, const IntVec& q) {
    std::size_t place = 0;
    for (int a = DIM - 1; a >= 0; --a)
      place = place * static_cast<std::size_t>(base) + static_cast<std::size_t>(mesh.block(b).index.coord[a] * n + q[a]);
    worst = std::max(worst, std::abs(solver.solution().at(g, i, 0)[o] - plain_x[place]));
    size = std::max(size, std::abs(plain_x[place]));
  });
  if (!(worst < 1e-6 * size)) state.SkipWithError("PFMG finds something else");
  state.counters["hypre_us_per_cell"] = median(plain_us);
  state.counters["hypre_iterations"] = plain_iterations;
  state.counters["ratio"] = median(ratios);
  state.counters["ratio_min"] = least(ratios);
  state.counters["ratio_max"] = greatest(ratios);
}

// (1/dt - div 2 nu D) v = f, dt nu/dx^2 = 500 where nu = 1; nu in the disc is `ratio`. With the pressure: the coupled system. On
// a uniform grid, or with so many levels round the surface.
enum class Unknowns { velocity, all };

void viscous(benchmark::State& state, Unknowns unknowns, int levels) {
  constexpr int CELLS_ALONG = DIM == 2 ? 512 : 64, BLOCK = 16;
  const double ratio = static_cast<double>(state.range(0));
  const amr::Mesh mesh = unit_box(CELLS_ALONG >> levels, levels, BLOCK);
  const double dx = 1.0 / CELLS_ALONG, sigma = 1 / (500 * dx * dx);
  physics::StokesOptions options;
  options.tolerance = unknowns == Unknowns::velocity ? 1e-8 : 1e-6;
  physics::StokesSolver solver(mesh, options);
  solver.set_viscosity(
      [&](int b, double* phi) {
        amr::for_each_cell(filled(-amr::Layout::GHOSTS), filled(mesh.layout().pitch()), [&](const IntVec& q) {
          RealVec x{};
          for (int a = 0; a < DIM; ++a) x[a] = mesh.block(b).lo[a] + (q[a] + 0.5) * mesh.block(b).dx;
          phi[mesh.layout().offset(q)] = std::tanh((RADIUS - from_centre(x)) / (2 * dx));
        });
      },
      [&](double phi) { return 1 + (ratio - 1) * 0.5 * (1 + phi); });
  for (int a = 0; a < DIM; ++a)
    for_each_place(mesh, solver.hierarchy(), a, [&](int g, int i, std::ptrdiff_t o, const RealVec& x, int, const IntVec&) {
      double f = a == 0 ? 1 : -1;
      for (int d = 0; d < DIM; ++d) f *= (d == a ? std::cos(3 * x[d]) : std::sin(5 * x[d]));
      solver.force().at(g, i, a)[o] = f;
    });
  physics::StokesResult result;
  std::vector<double> us;
  const auto run = [&] {
    return 1e6 / cells_of(mesh) * timed([&] {
      for (int g = 0; g < solver.hierarchy().levels(); ++g) solver.state().clear(g);
      result = unknowns == Unknowns::velocity ? solver.solve_momentum(sigma) : solver.solve(sigma);
    });
  };
  run();
  for (auto _ : state) {
    us.push_back(run());
    state.SetIterationTime(1e-6 * us.back() * cells_of(mesh));
  }
  if (!result.converged) state.SkipWithError("not converged");
  report(state, us, result.iterations, result.error, cells_of(mesh));
}

void solutions(benchmark::internal::Benchmark* b) {
  b->UseManualTime()->Repetitions(1)->Iterations(9)->Unit(benchmark::kMillisecond)->Arg(16);
  if (DIM == 2) b->Arg(32);
}

BENCHMARK_CAPTURE(scalar, uniform, 0, 1.0, Beside::pfmg)->Name("multigrid_uniform")->Apply(solutions);
BENCHMARK_CAPTURE(scalar, levels, LEVELS, 1.0, Beside::nothing)->Name("multigrid_levels")->Apply(solutions);
BENCHMARK_CAPTURE(scalar, uniform_beta, 0, 1e3, Beside::pfmg)->Name("multigrid_uniform_beta")->Apply(solutions);
BENCHMARK_CAPTURE(scalar, levels_beta, LEVELS, 1e3, Beside::nothing)->Name("multigrid_levels_beta")->Apply(solutions);

void ratios(benchmark::internal::Benchmark* b) {
  b->UseManualTime()->Repetitions(1)->Iterations(5)->Unit(benchmark::kMillisecond);
  for (const int r : {1, 100, 10000, 1000000}) b->Arg(r);
}

BENCHMARK_CAPTURE(viscous, velocity, Unknowns::velocity, 0)->Name("viscous_velocity")->Apply(ratios);
BENCHMARK_CAPTURE(viscous, all, Unknowns::all, 0)->Name("viscous_coupled")->Apply(ratios);
#if DENDRIFT_DIM == 2  // in 3D blocks of 16 round a sphere would fill the box
BENCHMARK_CAPTURE(viscous, velocity_levels, Unknowns::velocity, LEVELS)->Name("viscous_levels_velocity")->Apply(ratios);
BENCHMARK_CAPTURE(viscous, all_levels, Unknowns::all, LEVELS)->Name("viscous_levels_coupled")->Apply(ratios);
#endif

}  // namespace

}  // namespace dendrift::bench

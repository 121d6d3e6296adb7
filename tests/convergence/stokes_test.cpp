// The Stokes solver against numbers that do not come from it.
#include "physics/stokes.hpp"

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <map>

#include "physics/flow.hpp"
#include "support/mesh_fixture.hpp"

namespace dendrift::test {
namespace {

using physics::StokesOptions;
using physics::StokesSolver;

RealVec filled_real(double x) {
  RealVec r{};
  r.fill(x);
  return r;
}

RealVec place(const amr::Block& b, const IntVec& q, int normal) {
  RealVec x{};
  for (int a = 0; a < DIM; ++a) x[a] = b.lo[a] + (q[a] + (a == normal ? 0.0 : 0.5)) * b.dx;
  return x;
}

// A box of side `side` with walls, refined where want(block) says so. `open`: a face of the box that is none.
template <class Want>
amr::Mesh box(double side, int roots, int cells, int levels, Want&& want, const amr::FieldTable& fields = {}, int open = -1) {
  amr::MeshShape s;
  s.root_blocks = filled(roots);
  s.max_level = levels - 1;
  s.block_cells = cells;
  s.root_dx = side / (roots * cells);
  s.sides.fill(amr::Side::wall);
  if (open >= 0) s.sides[static_cast<std::size_t>(open)] = amr::Side::open;
  amr::Mesh mesh(s, fields, MPI_COMM_SELF);
  for (int level = 1; level < levels; ++level) {
    std::vector<std::int8_t> change(static_cast<std::size_t>(mesh.tree().size()));
    for (int i = 0; i < mesh.tree().size(); ++i)
      change[static_cast<std::size_t>(i)] = want(mesh.describe(mesh.tree().leaf(i))) ? 1 : 0;
    amr::Tree tree = mesh.tree().adapted(change);
    const std::vector<int> owners(static_cast<std::size_t>(tree.size()), 0);
    put(mesh, std::move(tree), owners);
  }
  return mesh;
}

template <class Force>
void set_force(StokesSolver& solver, const amr::Mesh& mesh, Force&& force) {
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = solver.hierarchy().place_of_block(b);
    for (int a = 0; a < DIM; ++a)
      amr::for_each_cell({}, filled(mesh.layout().n + 1), [&](const IntVec& q) {
        solver.force().at(g, i, a)[mesh.layout().offset(q)] = force(a, place(mesh.block(b), q, a));
      });
  }
}

struct Disc {
  double radius;
  RealVec centre;
  double phi(const RealVec& x) const {
    double r2 = 0;
    for (int a = 0; a < DIM; ++a) r2 += (x[a] - centre[a]) * (x[a] - centre[a]);
    return std::tanh((radius - std::sqrt(r2)) / std::sqrt(2.0));
  }
};

struct Settled {
  int iterations;
  double core, mean, divergence;
};

enum class Solid : std::uint8_t { viscous, penalised, held };

// A disc (sphere) of weight 1 a volume in a melt of viscosity 1, without inertia.
Settled settle(amr::Mesh& mesh, const Disc& disc, double ratio, physics::ViscosityLaw law, double sigma = 0,
               Solid kind = Solid::viscous, amr::BottomSolver bottom = amr::BottomSolver::direct) {
  StokesOptions o;
  o.bottom = bottom;
  o.tolerance = kind == Solid::penalised ? 1e-9 : 1e-6;
  StokesSolver solver(mesh, o);
  const int n = mesh.layout().n;
  const auto phase = [&](int b, double* phi) {
    for_all(mesh.layout(), [&](const IntVec& q) { phi[mesh.layout().offset(q)] = disc.phi(place(mesh.block(b), q, -1)); });
  };
  solver.set_viscosity(phase, [&](double phi) { return physics::relative_viscosity(law, ratio, phi); });
  if (kind != Solid::viscous)
    solver.set_drag(phase, physics::relative_drag,
                    kind == Solid::held ? std::vector<RealVec>{} : std::vector<RealVec>{disc.centre});
  set_force(solver, mesh, [&](int a, RealVec x) { return a == DIM - 1 ? 0.5 * (1 + disc.phi(x)) : 0.0; });
  const physics::StokesResult r = solver.solve(sigma);
  EXPECT_TRUE(r.converged);
  double core = 0, cores = 0, all = 0, solid = 0;
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = solver.hierarchy().place_of_block(b);
    amr::for_each_cell({}, filled(n), [&](const IntVec& q) {
      const double* u = solver.state().at(g, i, DIM - 1) + mesh.layout().offset(q);
      const double v = 0.5 * (u[0] + u[mesh.layout().stride(DIM - 1)]), volume = std::pow(mesh.block(b).dx, DIM);
      const double f = 0.5 * (1 + disc.phi(place(mesh.block(b), q, -1)));
      if (f > 0.999) core += volume * v, cores += volume;
      all += f * volume * v;
      solid += f * volume;
    });
  }
  return {r.iterations, core / cores, all / solid, r.divergence_max};
}

#if DENDRIFT_DIM == 2  // the numbers are for a disc

// A sharp disc of R = 10 in this box: U nu/F = .044211; ours carries the weight of its diffuse profile.
TEST(Stokes, PenalisedDiscFallsLikeASharpOne) {
  amr::Mesh uniform = box(80, 10, 16, 1, [](const amr::Block&) { return false; });
  const Disc disc{10, filled_real(40)};
  double weight = 0;
  for (int b = 0; b < uniform.size(); ++b)
    amr::for_each_cell({}, filled(16), [&](const IntVec& q) {
      weight += 0.25 * 0.5 * (1 + disc.phi(place(uniform.block(b), q, -1)));
    });
  const Settled s = settle(uniform, disc, 1, physics::ViscosityLaw::h3, 0, Solid::penalised);
  EXPECT_NEAR(s.core / weight, 0.044211, 0.012 * 0.044211);
  EXPECT_LT(settle(uniform, disc, 1, physics::ViscosityLaw::h3, 0, Solid::held).core, 2e-3 * s.core);
}

// A free disc of radius a in the middle of a drum of radius R that a drag holds: F/(nu U) = 4 pi/[ln(R/a) -
// (R^2-a^2)/(R^2+a^2)], and the torque 4 pi nu W a^2 R^2/(R^2-a^2), both for sharp surfaces.
TEST(Stokes, DiscInADrum) {
  constexpr double A = 16, R = 40, SIDE = 96;
  amr::Mesh mesh = box(SIDE, 12, 16, 1, [](const amr::Block&) { return false; });
  const Disc disc{A, filled_real(SIDE / 2)}, drum{R, filled_real(SIDE / 2)};
  StokesOptions o;
  o.tolerance = 1e-7;
  StokesSolver solver(mesh, o);
  const auto phase = [&](double sign, const Disc& d) {
    return [&mesh, &d, sign](int b, double* phi) {
      for_all(mesh.layout(), [&](const IntVec& q) { phi[mesh.layout().offset(q)] = sign * d.phi(place(mesh.block(b), q, -1)); });
    };
  };
  solver.set_viscosity(phase(1, disc), [](double phi) { return physics::relative_viscosity(physics::ViscosityLaw::h3, 1e6, phi); });
  solver.set_drag(phase(-1, drum), physics::relative_drag, {});
  const auto solid = [&](const RealVec& x) { return 0.5 * (1 + disc.phi(x)); };
  const auto turning = [&](int a, const RealVec& x) { return a == 0 ? -(x[1] - SIDE / 2) : x[0] - SIDE / 2; };
  for (const bool torque : {false, true}) {
    // A torque on the rigid part alone, a weight on all of the diffuse disc.
    const auto force = [&](int a, const RealVec& x) {
      if (torque) return disc.phi(x) > 0.9 ? turning(a, x) : 0.0;
      return a == 1 ? solid(x) : 0.0;
    };
    set_force(solver, mesh, force);
    ASSERT_TRUE(solver.solve(0).converged);
    double load = 0, motion = 0, cells = 0;
    for (int b = 0; b < mesh.size(); ++b) {
      const auto [g, i] = solver.hierarchy().place_of_block(b);
      const double dx = mesh.block(b).dx;
      amr::for_each_cell({}, filled(16), [&](const IntVec& q) {
        for (int a = 0; a < 2; ++a) {
          const RealVec x = place(mesh.block(b), q, a);
          load += dx * dx * force(a, x) * (torque ? turning(a, x) : a == 1 ? 1.0 : 0.0);
        }
        if (disc.phi(place(mesh.block(b), q, -1)) < 0.999) return;
        const std::ptrdiff_t p = mesh.layout().offset(q);
        const double *u = solver.state().at(g, i, 0) + p, *v = solver.state().at(g, i, 1) + p;
        motion += torque ? 0.5 * ((v[0] - v[-1]) - (u[0] - u[-mesh.layout().stride(1)])) / dx : v[0];
        ++cells;
      });
    }
    motion /= cells;
    const double sharp = torque ? 4 * M_PI * A * A * R * R / (R * R - A * A)
                                : 4 * M_PI / (std::log(R / A) - (R * R - A * A) / (R * R + A * A));
    EXPECT_NEAR(load / motion, sharp, 0.01 * sharp) << (torque ? "torque" : "force");
  }
}

// Direct sparse solutions of the staggered problem: h3 at ratio 1e5, R = 10, closed box of 80, nu_l = 1.
TEST(Stokes, DiffuseDiscFallsAtTheKnownSpeed) {
  amr::Mesh uniform = box(80, 5, 16, 1, [](const amr::Block&) { return false; });
  const Settled s = settle(uniform, {10, filled_real(40)}, 1e5, physics::ViscosityLaw::h3);
  EXPECT_NEAR(s.core, 13.99, 0.01 * 13.99);
  EXPECT_NEAR(s.mean, 13.78, 0.01 * 13.78);
  EXPECT_LT(s.divergence, 1e-5);
}

TEST(Stokes, LinearLawMakesTheDiscSlow) {
  // At dx = .5: this law, which is steep in nu, is .4 % off there and 1.5 % at dx = 1.
  amr::Mesh uniform = box(80, 10, 16, 1, [](const amr::Block&) { return false; });
  EXPECT_NEAR(settle(uniform, {10, filled_real(40)}, 1e6, physics::ViscosityLaw::linear).core, 3.296, 0.01 * 3.296);
}

// Levels that meet in the surface of a disc, along the way that it falls and across it: a limit of the mesh that
// |grad phi| keeps runs away from (docs/verification.md, "What disagrees"). Speeds may be anything where the coarse cells are as large
// as the surface is thick (roots 5), but the error must go with dx.
TEST(Stokes, BordersThatCutASurface) {
  const Disc disc{10, {40, 48}};
  for (const auto& [roots, most] : {std::pair{5, 0.0}, {10, 0.2}, {20, 0.02}}) {
    amr::Mesh even = box(80, 2 * roots, 8, 1, [](const amr::Block&) { return false; });
    const double right = settle(even, disc, 1e4, physics::ViscosityLaw::h3).core;
    for (const int axis : {0, 1}) {
      amr::Mesh cut = box(80, roots, 8, 2, [axis](const amr::Block& b) { return b.lo[axis] < 40; });
      const double speed = settle(cut, disc, 1e4, physics::ViscosityLaw::h3).core;
      if (roots > 5) {
        EXPECT_NEAR(speed, right, most * right) << axis;
      }
      RecordProperty(fmt::format("border_across_axis_{}_dx_{}", axis, 5.0 / roots), fmt::format("{} for {}", speed, right));
    }
  }
}

#endif

TEST(Stokes, RefinedMeshGivesTheUniformAnswer) {
  const double side = DIM == 2 ? 128 : 64;
  const Disc disc{10, filled_real(side / 2)};
  const auto near_disc = [&](const amr::Block& b) {
    double square = 0;
    for (int a = 0; a < DIM; ++a) {
      const double d = std::max(0.0, std::abs(b.lo[a] + 4 * b.dx - side / 2) - 4 * b.dx);
      square += d * d;
    }
    return square < 18 * 18;
  };
  const int levels = DIM == 2 ? 3 : 2;
  amr::Mesh fine = box(side, DIM == 2 ? 16 : 8, 8, 1, near_disc);
  amr::Mesh refined = box(side, (DIM == 2 ? 16 : 8) >> (levels - 1), 8, levels, near_disc);
  ASSERT_LT(refined.tree().size(), fine.tree().size());
  const double ratio = DIM == 2 ? 1e6 : 1e4;
  const Settled a = settle(fine, disc, ratio, physics::ViscosityLaw::h3), b = settle(refined, disc, ratio, physics::ViscosityLaw::h3);
  EXPECT_NEAR(b.core, a.core, 0.005 * a.core);
}

// A solid beside an open side, levels meeting on it: the same whether that is the low or the high side of the box.
TEST(Stokes, OpenSidesAreAlike) {
  const int n = DIM == 2 ? 8 : 4;
  const double side = 64;
  for (int axis = 0; axis < DIM; ++axis) {
    std::array<Settled, 2> s{};
    for (const int high : {0, 1}) {
      Disc disc{6, filled_real(side / 2)};
      disc.centre[axis] = high != 0 ? side - 8 : 8;
      amr::Mesh mesh = box(side, 2, n, 3, [&](const amr::Block& b) {
        double r2 = 0;
        for (int a = 0; a < DIM; ++a) r2 += std::pow(std::max({b.lo[a] - disc.centre[a], disc.centre[a] - b.lo[a] - n * b.dx, 0.0}), 2);
        return r2 < 100;
      }, {}, 2 * axis + high);
      ASSERT_GT(mesh.tree().finest_level(), 1);
      s[static_cast<std::size_t>(high)] = settle(mesh, disc, 100, physics::ViscosityLaw::h3);
    }
    EXPECT_NEAR(s[1].mean, s[0].mean, 1e-5 * s[0].mean) << "axis " << axis;
    EXPECT_EQ(s[1].iterations, s[0].iterations) << "axis " << axis;
  }
}

TEST(Stokes, HypreAsBottomOfTheCycles) {
  if (!amr::HypreSolver::available()) GTEST_SKIP() << "no hypre in this build";
  for (const int open : {-1, 2 * DIM - 1}) {
    const Disc disc{8, filled_real(18)};
    amr::Mesh mesh = box(64, 4, 8, 2, [](const amr::Block& b) { return *std::ranges::max_element(b.lo) < 30; }, {}, open);
    const Settled own = settle(mesh, disc, 1e4, physics::ViscosityLaw::h3, 1e-3);
    const Settled other = settle(mesh, disc, 1e4, physics::ViscosityLaw::h3, 1e-3, Solid::viscous, amr::BottomSolver::hypre);
    EXPECT_NEAR(other.iterations, own.iterations, 1);
    EXPECT_GT(own.mean, 0);
    EXPECT_NEAR(other.mean, own.mean, 1e-5 * own.mean);
  }
}

// With equal cells, and where melt and, in 2D, the middle of the solid have coarser ones: which cost no iterations either.
TEST(Stokes, IterationsDoNotGrowWithTheRatio) {
  std::map<double, std::map<double, int>> uniform;
  std::map<double, std::map<double, double>> speeds;
  for (const bool levels : {false, true}) {
    const double side = DIM == 2 ? 128 : levels ? 48 : 32, centre = side / 2;
    const Disc disc{DIM == 2 ? 36.0 : 6.0, filled_real(centre)};
    const auto round_surface = [&](const amr::Block& b) {
      double near = 0, far = 0;
      for (int a = 0; a < DIM; ++a) {
        const double lo = b.lo[a] - centre, hi = lo + 8 * b.dx;
        near += std::pow(std::max({lo, -hi, 0.0}), 2);
        far += std::pow(std::max(-lo, hi), 2);
      }
      return near < std::pow(disc.radius + 4, 2) && far > std::pow(disc.radius - 4, 2);
    };
    amr::Mesh mesh = levels ? box(side, DIM == 2 ? 4 : 3, 8, DIM == 2 ? 3 : 2, round_surface)
                            : box(side, DIM == 2 ? 8 : 2, 16, 1, round_surface);
    for (const double sigma : {0.0, 1e-3, 1.0}) {
      std::map<double, int> iterations;
      for (const double ratio : {1.0, 1e2, 1e4, 1e6, 1e8}) {
        const std::string what = fmt::format("{}, sigma {}, ratio {}", levels ? "levels" : "uniform", sigma, ratio);
        const Settled s = settle(mesh, disc, ratio, physics::ViscosityLaw::h3, sigma);
        iterations[ratio] = s.iterations;
        EXPECT_LT(s.divergence, 1e-4) << what;
        if (ratio > 1) {
          EXPECT_LE(s.iterations, (ratio > 1e6 ? 1.6 : 1.2) * iterations[1e2]) << what;
        }
        if (levels && ratio <= 1e6) {
          EXPECT_LE(s.iterations, uniform[sigma][ratio] + 2) << what;
        }
        if (!levels) speeds[sigma][ratio] = s.mean;
        if (DIM == 2 && levels) {  // in 3D the boxes differ
          EXPECT_NEAR(s.mean, speeds[sigma][ratio], 0.005 * speeds[sigma][ratio]) << what;
        }
      }
      if (!levels) uniform[sigma] = iterations;
    }
  }
}

// Mean over the core of a disc, in the plane of the first two axes.
double spin_of(StokesSolver& solver, const amr::Mesh& mesh, const Disc& disc) {
  double spin = 0, cells = 0;
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = solver.hierarchy().place_of_block(b);
    amr::for_each_cell({}, filled(mesh.layout().n), [&](const IntVec& q) {
      if (disc.phi(place(mesh.block(b), q, -1)) < 0.999) return;
      const std::ptrdiff_t p = mesh.layout().offset(q);
      const double *u = solver.state().at(g, i, 0) + p, *v = solver.state().at(g, i, 1) + p;
      spin += 0.5 * ((v[0] - v[-1]) - (u[0] - u[-mesh.layout().stride(1)])) / mesh.block(b).dx;
      ++cells;
    });
  }
  return spin / cells;
}

// A torque in the plane of the first two axes, and no force, on a solid of R = 10 in a wide box. Were the components of
// the velocity preconditioned apart, this would converge with next to no rotation.
TEST(Stokes, TorqueTurnsASolid) {
  const double side = DIM == 2 ? 256 : 64, centre = side / 2;
  const Disc disc{10, filled_real(centre)};
  amr::Mesh mesh = box(side, 2, 16, DIM == 2 ? 4 : 2, [&](const amr::Block& b) {
    for (int a = 0; a < DIM; ++a)
      if (b.lo[a] > centre + 16 || b.lo[a] + 16 * b.dx < centre - 16) return false;
    return true;
  });
  for (const double tolerance : {1e-5, 1e-8}) {
    StokesOptions o;
    o.tolerance = tolerance;
    StokesSolver solver(mesh, o);
    solver.set_viscosity(
        [&](int b, double* phi) {
          for_all(mesh.layout(), [&](const IntVec& q) { phi[mesh.layout().offset(q)] = disc.phi(place(mesh.block(b), q, -1)); });
        },
        [](double phi) { return physics::relative_viscosity(physics::ViscosityLaw::h3, 1e6, phi); });
    double torque = 0;  // f x r over the solid
    const auto force = [&](int a, const RealVec& x) {
      if (disc.phi(x) < 0.9) return 0.0;  // on the rigid part
      return a == 0 ? -(x[1] - centre) : a == 1 ? x[0] - centre : 0.0;
    };
    set_force(solver, mesh, force);
    ASSERT_TRUE(solver.solve(0).converged);
    for (int b = 0; b < mesh.size(); ++b) {
      const double dx = mesh.block(b).dx;
      amr::for_each_cell({}, filled(16), [&](const IntVec& q) {
        for (int a = 0; a < 2; ++a) {
          const RealVec x = place(mesh.block(b), q, a);
          torque += std::pow(dx, DIM) * force(a, x) * (a == 0 ? -(x[1] - centre) : x[0] - centre);
        }
      });
    }
    const double spin = spin_of(solver, mesh, disc);
    // Walls far away: 4 pi nu R^2 a unit of length for a cylinder, 8 pi nu R^3 for a sphere. The box slows the disc by
    // (R / radius of the box)^2, .6 %, and the sphere by the third power, 3 %.
    const double free = torque / (DIM == 2 ? 4 * M_PI * 100 : 8 * M_PI * 1000);
    EXPECT_NEAR(spin, (DIM == 2 ? 0.994 : 0.97) * free, 0.025 * free) << tolerance;
  }
}

// A solid of radius 8 in the middle of a stream, v = (y, 0) on all walls of a box of so many levels: it turns at -1/2 (Jeffery).
class InAStream {
 public:
  static constexpr double RADIUS = 8;

  InAStream(double side, int levels)
      : disc_{RADIUS, filled_real(side / 2)}, psi_(fields_.add_cell({.name = "psi", .symbol = "", .unit = "", .doc = ""})),
        mesh_(box(
            side, 2, 16, levels,
            [&](const amr::Block& b) {
              for (int a = 0; a < DIM; ++a)
                if (b.lo[a] > side / 2 + 16 || b.lo[a] + 16 * b.dx < side / 2 - 16) return false;
              return true;
            },
            fields_)) {
    for (int b = 0; b < mesh_.size(); ++b)
      for_all(mesh_.layout(), [&](const IntVec& q) {
        double square = 0;
        for (int a = 0; a < DIM; ++a) square += std::pow(mesh_.block(b).centre(q)[a] - side / 2, 2);
        mesh_.cells(psi_, b)[mesh_.layout().offset(q)] = RADIUS - std::sqrt(square);
      });
  }

  /// A solver that knows the solid as a crystal, or does not.
  std::unique_ptr<StokesSolver> solver(double tolerance, bool crystal) const {
    StokesOptions o;
    o.tolerance = tolerance;
    auto solver = std::make_unique<StokesSolver>(mesh_, o);
    for (int f = 0; f < FACES; ++f) {
      amr::SideValue v;
      v.centre = disc_.centre;
      v.gradient[1] = 1;
      solver->set_wall_velocity(0, f, v);
    }
    solver->set_viscosity(
        [&](int b, double* phi) {
          for_all(mesh_.layout(),
                  [&](const IntVec& q) { phi[mesh_.layout().offset(q)] = disc_.phi(place(mesh_.block(b), q, -1)); });
        },
        [](double phi) { return physics::relative_viscosity(physics::ViscosityLaw::h3, 1e6, phi); });
    if (crystal) {
      physics::Seed seed;
      seed.position = disc_.centre;
      solver->set_crystals(physics::find_neighbourhood(mesh_, psi_, {-1}, {seed}));
    }
    return solver;
  }

  /// The torque that slows the solid by `spin` in a wide box.
  void hold_back(StokesSolver& solver, double spin) const {
    const auto arm = [&](int a, const RealVec& x) {
      return disc_.phi(x) < 0.9 ? 0.0 : a == 0 ? -(x[1] - disc_.centre[1]) : a == 1 ? x[0] - disc_.centre[0] : 0.0;
    };
    double moment = 0;  // of r^2 over the core
    for (int b = 0; b < mesh_.size(); ++b)
      amr::for_each_cell({}, filled(16), [&](const IntVec& q) {
        for (int a = 0; a < 2; ++a)
          moment += std::pow(mesh_.block(b).dx, DIM) * std::pow(arm(a, place(mesh_.block(b), q, a)), 2);
      });
    const double resistance = DIM == 2 ? 4 * M_PI * RADIUS * RADIUS : 8 * M_PI * RADIUS * RADIUS * RADIUS;
    set_force(solver, mesh_, [&](int a, const RealVec& x) { return spin * resistance / moment * arm(a, x); });
  }

  double spin(StokesSolver& solver) const { return spin_of(solver, mesh_, disc_); }

 private:
  Disc disc_;
  amr::FieldTable fields_;
  amr::CellField psi_;
  amr::Mesh mesh_;
};

// Held back by a torque from 5 % of its spin, then let go. The solution with the torque is the first guess: it must not be taken
// for good. The cycle alone finds most of the rest where its last grid resolves the solid; the crystal's modes find it anywhere.
TEST(Stokes, WrongSpinOfAFirstGuess) {
  const InAStream scene(DIM == 2 ? 256 : 64, DIM == 2 ? 4 : 2);
  constexpr double HELD_BACK = 0.025;
  const auto first = scene.solver(1e-8, false);
  scene.hold_back(*first, HELD_BACK);
  ASSERT_TRUE(first->solve(0).converged);
  EXPECT_NEAR(scene.spin(*first), -0.5 + HELD_BACK, 0.2 * HELD_BACK);
  for (const bool known : {true, false}) {
    const auto solver = scene.solver(1e-5, known);
    solver->state() = first->state();
    const physics::StokesResult r = solver->solve(0);
    EXPECT_TRUE(r.converged);
    if (known) {
      EXPECT_NEAR(scene.spin(*solver), -0.5, 0.2 * HELD_BACK) << r.iterations;
      EXPECT_LT(r.iterations, 10);
    } else if (DIM == 2) {
      EXPECT_NEAR(scene.spin(*solver), -0.5, 0.5 * HELD_BACK) << r.iterations;
    }
  }
}

#if DENDRIFT_DIM == 2

// The same in so wide a stream that the tolerance, which is of the norm of all velocities, lets the wrong spin pass: by some 200
// tolerances of the largest speed. The torque that it leaves has its say where the solid is known as a crystal.
TEST(Stokes, TorqueHasItsSay) {
  const InAStream scene(65536, 12);
  constexpr double HELD_BACK = 0.025, TOLERANCE = 3e-8;
  const auto first = scene.solver(1e-9, true), right = scene.solver(1e-9, true);
  scene.hold_back(*first, HELD_BACK);
  ASSERT_TRUE(first->solve(0).converged);
  ASSERT_TRUE(right->solve(0).converged);
  const double spin = scene.spin(*right);
  EXPECT_NEAR(spin, -0.5, 0.005);
  for (const bool crystal : {false, true}) {
    const auto solver = scene.solver(TOLERANCE, crystal);
    solver->state() = first->state();
    const physics::StokesResult r = solver->solve(0);
    EXPECT_TRUE(r.converged);
    const double tolerances = std::abs(scene.spin(*solver) - spin) * InAStream::RADIUS / (r.fastest * TOLERANCE);
    if (crystal) {
      EXPECT_LT(tolerances, 30) << r.iterations;
    } else {
      EXPECT_GT(tolerances, 100) << r.iterations;
    }
  }
}

// No slip at the walls of the unit box: v = curl of [sin(pi x) sin(pi y)]^2, p = cos(pi x) sin(pi y), and nu = ratio^f with
// f = (1 + phi)/2 of a disc whose surface is .1 thick. Errors of the velocity in the root mean square, mesh after mesh.
std::vector<double> manufactured(double ratio) {
  const double range = std::log(ratio);
  const auto u = [](double x, double y) { return std::pow(std::sin(M_PI * x), 2) * std::sin(2 * M_PI * y); };
  const auto lap = [](double x, double y) {  // of u
    return M_PI * M_PI * std::sin(2 * M_PI * y) * (2 * std::cos(2 * M_PI * x) - 4 * std::pow(std::sin(M_PI * x), 2));
  };
  const auto phase = [](const RealVec& x) { return std::tanh((0.23 - std::hypot(x[0] - 0.47, x[1] - 0.52)) / 0.1); };
  const auto force = [&](int a, const RealVec& x) {
    const double phi = phase(x), nu = std::exp(range * 0.5 * (1 + phi)), r = std::hypot(x[0] - 0.47, x[1] - 0.52);
    const double slope = -nu * range * 0.5 * (1 - phi * phi) / 0.1 / r;  // of nu along r, over r
    const double u_x = M_PI * std::sin(2 * M_PI * x[0]) * std::sin(2 * M_PI * x[1]);
    const double shear = 2 * M_PI * (std::pow(std::sin(M_PI * x[0]), 2) * std::cos(2 * M_PI * x[1]) -
                                     std::pow(std::sin(M_PI * x[1]), 2) * std::cos(2 * M_PI * x[0]));
    const double nu_x = slope * (x[0] - 0.47), nu_y = slope * (x[1] - 0.52);
    return a == 0 ? -nu * lap(x[0], x[1]) - 2 * nu_x * u_x - nu_y * shear - M_PI * std::sin(M_PI * x[0]) * std::sin(M_PI * x[1])
                  : nu * lap(x[1], x[0]) - nu_x * shear + 2 * nu_y * u_x + M_PI * std::cos(M_PI * x[0]) * std::cos(M_PI * x[1]);
  };
  std::vector<double> errors;
  for (const int roots : {4, 8, 16}) {
    amr::Mesh mesh = box(1, roots, 8, 2, [](const amr::Block& b) {
      const double width = 8 * b.dx;
      return b.lo[0] > 0.24 && b.lo[0] + width < 0.76 && b.lo[1] > 0.24 && b.lo[1] + width < 0.76;
    });
    StokesOptions o;
    o.tolerance = 1e-9;
    StokesSolver solver(mesh, o);
    solver.set_viscosity(
        [&](int b, double* phi) {
          for_all(mesh.layout(), [&](const IntVec& q) { phi[mesh.layout().offset(q)] = phase(place(mesh.block(b), q, -1)); });
        },
        [&](double phi) { return std::exp(range * 0.5 * (1 + phi)); });
    set_force(solver, mesh, force);
    EXPECT_TRUE(solver.solve(0).converged);
    double square = 0;
    for (int b = 0; b < mesh.size(); ++b) {
      const auto [g, i] = solver.hierarchy().place_of_block(b);
      for (int a = 0; a < 2; ++a)
        amr::for_each_cell({}, filled(mesh.layout().n), [&, g = g, i = i](const IntVec& q) {
          const RealVec x = place(mesh.block(b), q, a);
          const double want = a == 0 ? u(x[0], x[1]) : -u(x[1], x[0]);
          const double e = solver.state().at(g, i, a)[mesh.layout().offset(q)] - want;
          square += e * e * mesh.block(b).dx * mesh.block(b).dx;
        });
    }
    errors.push_back(std::sqrt(square));
  }
  return errors;
}

// The levels meet within the surface of the disc, where nu is between 1 and the ratio.
TEST(Stokes, OrderTwoAcrossLevels) {
  for (const double ratio : {1.0, 1e3, 1e6}) {
    const std::vector<double> e = manufactured(ratio);
    const std::string what = fmt::format("ratio {}: {:.3e} {:.3e} {:.3e}", ratio, e[0], e[1], e[2]);
    EXPECT_GT(std::log2(e[0] / e[1]), 1.8) << what;
    EXPECT_GT(std::log2(e[1] / e[2]), 1.8) << what;
  }
}

#endif

}  // namespace
}  // namespace dendrift::test

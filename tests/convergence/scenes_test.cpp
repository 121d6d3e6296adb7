// Sides that move or let melt through, periodic boxes, and seeds that are not round: what scenes of flow are made of.
#include <gtest/gtest.h>

#include <map>

#include "physics/flow.hpp"
#include "support/mesh_fixture.hpp"
#include "support/scene.hpp"

namespace dendrift::test {
namespace {

RealVec face_place(const amr::Block& b, const IntVec& q, int normal) {
  RealVec x{};
  for (int a = 0; a < DIM; ++a) x[a] = b.lo[a] + (q[a] + (a == normal ? 0.0 : 0.5)) * b.dx;
  return x;
}

// A box of 4 blocks of 8 cells a side, its middle refined.
amr::Mesh refined_box(double side) {
  amr::MeshShape s;
  s.root_blocks = filled(4);
  s.max_level = 1;
  s.block_cells = 8;
  s.root_dx = side / 32;
  s.sides.fill(amr::Side::wall);
  amr::Mesh mesh(s, {}, MPI_COMM_SELF);
  std::vector<std::int8_t> change;
  for (int i = 0; i < mesh.tree().size(); ++i) {
    const IntVec at = mesh.tree().leaf(i).coord;
    // The low corner as well: levels meet at a side of the box.
    change.push_back(std::ranges::all_of(at, [](int c) { return c == 1 || c == 2; }) || at == IntVec{} ? 1 : 0);
  }
  amr::Tree tree = mesh.tree().adapted(change);
  const std::vector<int> owners(static_cast<std::size_t>(tree.size()), 0);
  put(mesh, std::move(tree), owners);
  return mesh;
}

TEST(Sides, AffineWallsMakeTheAffineFlow) {
  amr::Mesh mesh = refined_box(2);
  physics::StokesOptions o;
  o.tolerance = 5e-12;
  o.max_iterations = 1000;
  physics::StokesSolver solver(mesh, o);
  solver.set_viscosity([&](int, double* phi) { for_all(mesh.layout(), [&](const IntVec& q) { phi[mesh.layout().offset(q)] = -1; }); },
                       [](double) { return 1.0; });
  const auto gradient = [](int c, int a) { return c == a ? (c == 0 ? DIM - 1.0 : -1.0) : 0.3 * (c + 1) + 0.7 * a; };  // no trace
  const auto velocity = [&](const RealVec& x, int c) {
    double v = 0.2 + 0.1 * c;
    for (int a = 0; a < DIM; ++a) v += gradient(c, a) * (x[a] - 1);
    return v;
  };
  for (int f = 0; f < FACES; ++f)
    for (int c = 0; c < DIM; ++c) {
      amr::SideValue v{0.2 + 0.1 * c};
      v.centre.fill(1);
      for (int a = 0; a < DIM; ++a) v.gradient[a] = gradient(c, a);
      solver.set_wall_velocity(c, f, v);
    }
  ASSERT_TRUE(solver.solve(0).converged);
  Tally tally;
  for (int b = 0; b < mesh.size(); ++b) {
    const auto [g, i] = solver.hierarchy().place_of_block(b);
    for (int c = 0; c < DIM; ++c) {
      IntVec size = filled(mesh.layout().n);
      ++size[c];
      amr::for_each_cell({}, size, [&](const IntVec& q) {
        // 100 times the tolerance: what the residual says of the error
        tally.near(solver.state().at(g, i, c)[mesh.layout().offset(q)], velocity(face_place(mesh.block(b), q, c), c), 5e-10,
                   [&] { return "block " + std::to_string(b) + ", face " + text(q); });
      });
    }
  }
  EXPECT_TRUE(tally.result());
}

std::string flow_scene(const std::string& sides, const std::string& flow, const std::string& seeds = "") {
  return "[run]\nend_time_tau0 = 1\n[mesh]\ndim = " + std::to_string(DIM) + "\nsize_W0 = " + vector_text(64) + "\ndx_W0 = 2\n" + sides +
         "[alloy]\nviscosity_um2_s = 1e8\n" + seeds + "[phase_field]\nfrozen = true\nrigid = true\n[flow]\nsolutal_buoyancy = false\n" +
         "inertia = false\ntolerance = 1e-9\n" + flow;
}

// What the code says of the key.
std::string complaint(const std::string& toml, const std::string& key) {
  Settings settings;
  try {
    settings.parse_text(toml, "test", {});
  } catch (const io::InputError& e) {
    for (const io::InputIssue& i : e.issues())
      if (i.key == key) return i.expected;
    return std::string("not about it: ") + e.what();
  }
  return "none";
}

TEST(Sides, WhatFlowsInMustFlowOut) {
  const std::string in = std::string("xlo_velocity_W0_tau0 = [0.5, 0") + (DIM == 3 ? ", 0]\n" : "]\n");
  const std::string out = std::string("xhi_velocity_W0_tau0 = [0.5, 0") + (DIM == 3 ? ", 0]\n" : "]\n");
  const std::string zeros = DIM == 3 ? ", 0, 0, 0, 0, 0]\n" : "]\n";
  EXPECT_EQ(complaint(flow_scene("", in), "flow"), "no net flow through the sides, or a side that is open");
  EXPECT_EQ(complaint(flow_scene("", in + out), "flow"), "none");
  EXPECT_EQ(complaint(flow_scene("xhi = \"open\"\n", in), "flow"), "none");
  // A parabola carries two thirds in 2D, four ninths in 3D.
  EXPECT_NE(complaint(flow_scene("", in + out + "xlo_profile = \"parabolic\"\n"), "flow"), "none");
  EXPECT_EQ(complaint(flow_scene("", in + out + "xlo_profile = \"parabolic\"\nxhi_profile = \"parabolic\"\n"), "flow"), "none");
  if (DIM == 2) {
    EXPECT_EQ(complaint(flow_scene("", "wall_gradient_per_tau0 = [1, 0, 0, -1]\n"), "flow"), "none");
    EXPECT_NE(complaint(flow_scene("", "wall_gradient_per_tau0 = [1, 0, 0, -0.999]\n"), "flow"), "none");
    EXPECT_NE(complaint(flow_scene("xlo = \"periodic\"\nxhi = \"periodic\"\n", "wall_gradient_per_tau0 = [0, 0, 1, 0]\n"),
                        "flow.wall_gradient_per_tau0"), "none");
    EXPECT_NE(complaint(flow_scene("", "velocity_gradient_per_tau0 = [1, 0, 0, 1]\n"), "flow.velocity_gradient_per_tau0"), "none");
  }
  EXPECT_NE(complaint(flow_scene("xlo = \"symmetry\"\n", in), "flow.xlo_velocity_W0_tau0"), "none");
}

template <class Use>
void for_faces(Scene& scene, int axis, Use&& use) {
  const int id = scene->field("velocity_x").id;
  for (int b = 0; b < scene->mesh().size(); ++b) {
    const double* v = scene->mesh().faces({id}, axis, b);
    amr::for_each_cell({}, filled(scene->mesh().layout().n), [&](const IntVec& q) {
      use(face_place(scene->mesh().block(b), q, axis), v[scene->mesh().layout().offset(q)], scene->mesh().block(b).dx);
    });
  }
}

#if DENDRIFT_DIM == 2
TEST(Sides, ParabolaStaysOneFromInletToOpenEnd) {
  Scene scene(flow_scene("xhi = \"open\"\n", "xlo_velocity_W0_tau0 = [1, 0]\nxlo_profile = \"parabolic\"\n"));
  scene.advance_to(1);
  // The discrete flow that carries as much is (1 - h^2/2)(1 - y^2 + h^2/4), in units of half the width.
  double far = 0;
  for_faces(scene, 0, [&](const RealVec& x, double v, double dx) {
    const double y = (x[1] - 32) / 32, h = dx / 32, there = (1 - h * h / 2) * (1 - y * y + h * h / 4);
    EXPECT_NEAR(v, there, h * h / 3) << x[0] << " " << x[1];  // means of the parabola at the inlet
    if (x[0] > 48) far = std::max(far, std::abs(v - there));
  });
  EXPECT_LT(far, 1e-4);
  for_faces(scene, 1, [&](const RealVec& x, double v, double dx) { EXPECT_NEAR(v, 0, dx * dx / 1024 / 3) << x[0] << " " << x[1]; });
}
#endif

TEST(Sides, PrescribedShearTurnsAndCarriesCrystals) {
  const double side = 64, rate = 0.01;
  const std::string g = DIM == 2 ? "[0, -0.01, 0.01, 0]" : "[0, -0.01, 0, 0.01, 0, 0, 0, 0, 0]";
  std::string seed = std::string("[[seed]]\nposition_W0 = [48, 32") + (DIM == 3 ? ", 32]\n" : "]\n") + "radius_W0 = 8\n";
  Scene scene(flow_scene("", "velocity_gradient_per_tau0 = " + g + "\n", seed));
  scene.advance_to(50);
  RealVec centre{};
  double solid = 0;
  const amr::Layout& layout = scene->mesh().layout();
  for (int b = 0; b < scene->mesh().size(); ++b) {
    const double* psi = scene->mesh().cells(scene->field("psi"), b);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
      const double f = (1 + std::tanh(psi[layout.offset(q)] / std::sqrt(2.0))) / 2 * std::pow(scene->mesh().block(b).dx, DIM);
      const RealVec x = face_place(scene->mesh().block(b), q, -1);
      solid += f;
      for (int a = 0; a < DIM; ++a) centre[a] += f * x[a];
    });
  }
  // On a circle about the middle; second order in steps of .3.
  EXPECT_NEAR(centre[0] / solid, side / 2 + 16 * std::cos(50 * rate), 0.02);
  EXPECT_NEAR(centre[1] / solid, side / 2 + 16 * std::sin(50 * rate), 0.02);
}

TEST(Sides, PeriodicBoxKeepsItsMeanVelocity) {
  std::string sides;
  for (const char* face : {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"})
    if (DIM == 3 || face[0] != 'z') sides += std::string(face) + " = \"periodic\"\n";
  const std::string seed = "[[seed]]\nposition_W0 = " + vector_text(32) + "\nradius_W0 = 12\n";
  Scene scene(flow_scene(sides, "viscosity_ratio = 1e4\n", seed));
  std::vector<double> fastest;
  for (const double t : {0.9, 1.8}) {
    scene.advance_to(t);
    double sum = 0, volume = 0, most = 0;
    for_faces(scene, DIM - 1, [&](const RealVec&, double v, double dx) {
      sum += v * std::pow(dx, DIM);
      volume += std::pow(dx, DIM);
      most = std::max(most, std::abs(v));
    });
    EXPECT_LT(std::abs(sum / volume), 1e-13 * most);
    fastest.push_back(most);
  }
  EXPECT_GT(fastest[0], 0);
  EXPECT_NEAR(fastest[1], fastest[0], 0.01 * fastest[0]);  // settles, and is not accelerated
}

TEST(Inertia, DoesNotKnowTheBlocks) {
  std::string sides;
  for (const char* face : {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"})
    if (DIM == 3 || face[0] != 'z') sides += std::string(face) + " = \"periodic\"\n";
  const std::string start = std::string("initial_velocity_W0_tau0 = [0.2, -0.1") + (DIM == 3 ? ", 0.1]\n" : "]\n");
  const std::string text = flow_scene(sides, start + "initial_vortex_W0_tau0 = 0.3\n");
  const auto velocities = [&](int cells, int roots) {
    const std::string n = std::to_string(roots);
    Scene scene(text, {"mesh.block_cells=" + std::to_string(cells), "mesh.root_blocks=[" + n + "," + n + (DIM == 3 ? "," + n + "]" : "]"),
                       "mesh.levels=1", "flow.inertia=true", "alloy.viscosity_um2_s=100", "flow.max_interval_tau0=0.3"});
    scene.advance_to(3);
    std::map<RealVec, double> v;
    for (int a = 0; a < DIM; ++a)
      for_faces(scene, a, [&](const RealVec& x, double value, double) { v[x] = value; });
    return v;
  };
  const auto large = velocities(16, 1), small = velocities(8, 2);
  ASSERT_EQ(large.size(), small.size());
  ASSERT_EQ(large.size(), static_cast<std::size_t>(DIM * volume(filled(16))));
  for (const auto& [x, v] : large) EXPECT_NEAR(v, small.at(x), 1e-6) << x[0] << " " << x[1];
}

TEST(Seeds, EllipseHasTheSignedDistanceOfItsSurface) {
  physics::Seed s;
  s.radius = 12;
  s.aspect_ratio = 3;
  for (int a = 0; a < DIM; ++a) s.axes[a][a] = 1;
  s.axes[0][0] = s.axes[1][1] = 0.6;
  s.axes[0][1] = 0.8;
  s.axes[1][0] = -0.8;
  const auto [a, b] = s.semi_axes();
  EXPECT_DOUBLE_EQ(a / b, 3);
  EXPECT_NEAR(a * std::pow(b, DIM - 1), std::pow(12, DIM), 1e-10);
  const auto at = [&](double along, double across) {
    RealVec r{};
    r[0] = 0.6 * along - 0.8 * across;
    r[1] = 0.8 * along + 0.6 * across;
    return r;
  };
  EXPECT_NEAR(s.depth(at(a + 5, 0)), -5, 1e-12);
  EXPECT_NEAR(s.depth(at(0, b + 5)), -5, 1e-12);
  EXPECT_NEAR(s.depth(at(0, 0)), b, 1e-12);
  EXPECT_NEAR(s.depth(at(0, 0.25 * b)), 0.75 * b, 1e-12);
  for (double t = 0.05; t < 6.3; t += 0.1) {  // along the normals of the surface
    const double x = a * std::cos(t), y = b * std::sin(t), nx = b * std::cos(t), ny = a * std::sin(t), norm = std::hypot(nx, ny);
    for (const double d : {-1.0, 0.0, 0.5, 10.0})  // the smallest radius of curvature is b^2/a > 1
      EXPECT_NEAR(s.depth(at(x + d * nx / norm, y + d * ny / norm)), -d, 1e-7) << t << " " << d;
  }
}

}  // namespace
}  // namespace dendrift::test

// Labels, contact and later seeds in scenes of several crystals.
#include <fmt/format.h>
#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <numbers>

#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"
#include "support/scene.hpp"

namespace dendrift::test {
namespace {

std::string vec_text(double x, double y) { return DIM == 2 ? fmt::format("[{}, {}]", x, y) : fmt::format("[{}, {}, {}]", x, y, y); }

std::string scene_text(const std::string& size, const std::string& sides, const std::string& more) {
  std::string s = fmt::format("[run]\nend_time_tau0 = 10000\n[mesh]\ndim = {}\nsize_W0 = {}\nblock_cells = 8\n", DIM, size);
  for (const char* face : {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"})
    if (DIM == 3 || face[0] != 'z') s += fmt::format("{} = \"{}\"\n", face, sides);
  return s + more;
}

std::string seed(const std::string& position, double radius, const std::string& more = "") {
  return fmt::format("[[seed]]\nposition_W0 = {}\nradius_W0 = {}\n{}\n", position, radius, more);
}

// Volume of solid with each label.
std::map<int, double> volumes(Scene& scene) {
  std::map<int, double> v;
  const amr::Mesh& mesh = scene->mesh();
  const amr::CellField grain{scene->field("grain").id}, psi{scene->field("psi").id};
  for (int b = 0; b < mesh.size(); ++b)
    amr::for_each_cell({}, filled(mesh.layout().n), [&](const IntVec& q) {
      const std::ptrdiff_t o = mesh.layout().offset(q);
      v[static_cast<int>(mesh.cells(grain, b)[o])] +=
          0.5 * (1 + physics::phi_of_psi(mesh.cells(psi, b)[o])) * std::pow(mesh.block(b).dx, DIM);
    });
  return v;
}

#if DENDRIFT_DIM == 2
// Two discs that overlap, carried round a periodic box and turned: what is whose must not change, however slow they are.
TEST(Grains, BoundariesRideWithTheCrystals) {
  for (const double speed : {0.05, 1.0}) {
    Scene scene(scene_text("[128, 64]", "periodic",
                           seed("[54, 32]", 12) + seed("[73, 32]", 9) +
                               fmt::format("[phase_field]\nfrozen = true\n[flow]\nvelocity_W0_tau0 = [{}, {}]\n", speed, 0.37 * speed)));
    std::map<int, double> before = volumes(scene);
    const double way = speed < 0.1 ? 8 : 256;  // W0 along x
    scene.advance_to(way / speed);
    std::map<int, double> after = volumes(scene);
    ASSERT_EQ(after.size(), 2U);
    // Half a cell of a boundary 11 W0 long, and what crystals gain or lose on the way.
    for (const int g : {0, 1}) EXPECT_NEAR(after[g], before[g], 8) << speed << " " << g;
    for (const int g : {0, 1}) EXPECT_TRUE(scene->crystals()[static_cast<std::size_t>(g)].touching);
    EXPECT_EQ(scene->crystals()[0].contacts, 1);
  }
}

// The same in a solid that turns: the boundary turns with it.
TEST(Grains, BoundariesTurnWithTheCrystals) {
  Scene scene(scene_text("[96, 96]", "wall",
                         seed("[40, 48]", 12) + seed("[59, 48]", 12) +
                             "[phase_field]\nfrozen = true\n[flow]\nvelocity_gradient_per_tau0 = [0, -0.05, 0.05, 0]\n"));
  const double quarter = std::numbers::pi / 2 / 0.05;
  scene.advance_to(quarter);
  const amr::Mesh& mesh = scene->mesh();
  const amr::CellField grain{scene->field("grain").id}, psi{scene->field("psi").id};
  int wrong = 0, cells = 0;
  for (int b = 0; b < mesh.size(); ++b)
    amr::for_each_cell({}, filled(mesh.layout().n), [&](const IntVec& q) {
      const std::ptrdiff_t o = mesh.layout().offset(q);
      if (mesh.cells(psi, b)[o] < 0) return;
      const double y = mesh.block(b).lo[1] + (q[1] + 0.5) * mesh.block(b).dx;
      ++cells;
      if (std::abs(y - 49.5) > 1.5 && (y > 49.5) != (mesh.cells(grain, b)[o] == 1)) ++wrong;  // they started at x = 49.5
    });
  EXPECT_GT(cells, 500);
  EXPECT_LE(wrong, cells / 100);
  EXPECT_NEAR(volumes(scene)[0], volumes(scene)[1], 30);
}
#endif

// Crystals that grow towards each other keep the label of the nearer one, and report when they meet.
TEST(Grains, MeetHalfway) {
  const double middle = DIM == 2 ? 24 : 16, apart = DIM == 2 ? 24 : 22;
  Scene scene(scene_text(DIM == 2 ? "[96, 48]" : "[64, 32, 32]", "symmetry",
                         seed(vec_text(middle * 2 - apart / 2, middle), 8) + seed(vec_text(middle * 2 + apart / 2, middle), 8) +
                             "[alloy]\nsupersaturation = 0.6\n"));
  EXPECT_FALSE(scene->crystals()[0].touching);
  double met = 0;
  for (double t = 1; t <= 200 && met == 0; t += 1) {
    scene.advance_to(t);
    if (scene->crystals()[0].contacts > 0) met = t;
  }
  EXPECT_GT(met, 1);
  EXPECT_TRUE(scene->crystals()[1].touching);
  const std::map<int, double> v = volumes(scene);
  EXPECT_NEAR(v.at(0), v.at(1), 0.01 * v.at(0));
}

// A seed that comes later: not before its time, only in undercooled melt, and no solute comes or goes.
TEST(Grains, LaterSeeds) {
  const double m = DIM == 2 ? 48 : 32;
  const std::string late = "nucleation_time_tau0 = 3";
  Scene scene(scene_text(DIM == 2 ? "[96, 96]" : "[64, 64, 64]", "symmetry",
                         seed(vec_text(0.4 * m, 0.4 * m), 6) + seed(vec_text(1.4 * m, 1.4 * m), 6, late) + seed(vec_text(2 * m, 0), 6, late) +
                             seed(vec_text(0.4 * m, 0.45 * m), 6, late) + "[alloy]\nsupersaturation = 0.5\n"));
  const auto totals = [&] { return scene->totals(); };
  const double solute = totals().solute_mean;
  scene.advance_to(2.9);
  EXPECT_FALSE(scene->crystals()[1].present);
  const double before = totals().solid_fraction;
  scene.advance_to(3.5);
  EXPECT_TRUE(scene->crystals()[1].present);
  EXPECT_TRUE(scene->crystals()[2].present);  // in a corner
  EXPECT_FALSE(scene->crystals()[3].present);  // inside the first crystal
  EXPECT_TRUE(scene->crystals()[3].refused);
  const double box = std::pow(2 * m, DIM), one = DIM == 2 ? std::numbers::pi * 36 : 4.0 / 3 * std::numbers::pi * 216;
  EXPECT_GT(totals().solid_fraction * box, before * box + 0.9 * one * (1 + 1.0 / CHILDREN));
  EXPECT_NEAR(volumes(scene)[1], one, one);  // half a tau0 of growth, and the interface beyond the radius
  EXPECT_NEAR(totals().solute_mean / solute, 1, 1e-14);
  scene.advance_to(12);
  EXPECT_NEAR(totals().solute_mean / solute, 1, 1e-14);
  const std::map<int, double> v = volumes(scene);
  EXPECT_GT(v.at(1), 1.05 * one);  // it lives
  EXPECT_GT(v.at(2), 1.05 * one / CHILDREN);
}

// A crystal too small to live: it goes, and the rest goes on.
TEST(Grains, RemeltAndDisappear) {
  const double m = DIM == 2 ? 32 : 16;
  Scene scene(scene_text(DIM == 2 ? "[64, 64]" : "[32, 32, 32]", "symmetry",
                         seed(vec_text(0.5 * m, 0.5 * m), 2.5, "angle_deg = 10") + seed(vec_text(2 * m, 2 * m), DIM == 2 ? 20 : 12) +
                             "[alloy]\nsupersaturation = 0.02\n[flow]\nmax_interval_tau0 = 1\n"));
  const double solute = scene->totals().solute_mean;
  scene.advance_to(30);
  std::map<int, double> v = volumes(scene);
  EXPECT_LT(v[0], 0.05);
  EXPECT_GT(v[1], 100);
  EXPECT_EQ(scene->crystals()[0].contacts, 0);
  EXPECT_TRUE(std::isfinite(scene->crystals()[0].velocity[0]));
  EXPECT_NEAR(scene->totals().solute_mean / solute, 1, 1e-13);
}

#if DENDRIFT_DIM == 2
// Two crystals in touch, carried round for a thousand changes of the mesh.
TEST(Grains, LabelsOutliveAThousandRegrids) {
  Scene scene(scene_text("[64, 64]", "periodic",
                         seed("[26, 32]", 8) + seed("[39, 32]", 7, "angle_deg = 45") +
                             "[phase_field]\nfrozen = true\n[flow]\nvelocity_W0_tau0 = [1.3, -0.7]\n"),
              {"mesh.max_regrid_steps=1"});
  std::map<int, double> before = volumes(scene);
  int changes = 0, blocks = 0;
  for (int i = 0; i < 1000; ++i) {
    scene->step(scene->max_dt());
    changes += scene->mesh().tree().size() != blocks ? 1 : 0;
    blocks = scene->mesh().tree().size();
  }
  EXPECT_GT(changes, 50);
  std::map<int, double> after = volumes(scene);
  ASSERT_EQ(after.size(), 2U);
  for (const int g : {0, 1}) EXPECT_NEAR(after[g], before[g], 8) << g;
}

// 200 crystals that appear one after the other, wherever that is: at borders of blocks, of levels, beside each other.
TEST(Grains, TwoHundred) {
  Scene scene(scene_text("[768, 768]", "periodic",
                         "[seeds]\ncount = 200\nradius_W0 = 5\nclearance_W0 = 8\nlast_nucleation_time_tau0 = 8\n[alloy]\nsupersaturation = 0.4\n"));
  const double solute = scene->totals().solute_mean;
  scene.advance_to(10);
  int present = 0;
  for (const physics::Seed& s : scene->crystals()) present += s.present ? 1 : 0;
  EXPECT_GT(present, 150);
  EXPECT_EQ(static_cast<int>(volumes(scene).size()), present);
  EXPECT_NEAR(scene->totals().solute_mean / solute, 1, 1e-13);
}

// Seeds a W0 apart: of the same orientation, of nearly the same, and at 45 degrees.
TEST(Grains, GrowTogether) {
  std::map<double, double> solid;
  for (const double angle : {0.0, 5.0, 45.0, 85.0}) {
    Scene scene(scene_text("[96, 64]", "symmetry",
                           seed("[39, 32]", 8) + seed("[56, 32]", 8, fmt::format("angle_deg = {}", angle)) +
                               "[alloy]\nsupersaturation = 0.5\n"));
    scene.advance_to(20);
    EXPECT_EQ(scene->crystals()[0].contacts, 1) << angle;
    solid[angle] = scene->totals().solid_fraction;
    EXPECT_GT(solid[angle] * 96 * 64, 2 * std::numbers::pi * 64 * 1.05) << angle;
  }
  EXPECT_NEAR(solid[5], solid[85], 1e-10 * solid[5]);  // mirror images
  EXPECT_NE(solid[0], solid[45]);
}
#endif

}  // namespace
}  // namespace dendrift::test

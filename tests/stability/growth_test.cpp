// Hard cases: each must end with a finite state that conserves solute and keeps phi and c within bounds.
#include <gtest/gtest.h>

#include <cmath>

#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"
#include "support/scene.hpp"

namespace dendrift::test {
namespace {

void expect_sound(Scene& scene, const std::string& what) {
  const Totals t = scene->totals();
  ASSERT_TRUE(std::isfinite(t.solute_mean)) << what;
  EXPECT_LT(std::abs(scene->solute_drift(t)), 1e-12) << what;
  amr::Mesh& mesh = scene->mesh();
  double least = 1e30, most = -1e30;
  for (int b = 0; b < mesh.size(); ++b)
    amr::for_each_cell({}, filled(mesh.layout().n), [&](const IntVec& c) {
      const double v = mesh.cells(scene->field("c"), b)[mesh.layout().offset(c)];
      least = std::min(least, v);
      most = std::max(most, v);
    });
  EXPECT_GT(least, 0) << what;
  EXPECT_LT(most, 1.5) << what;
}

TEST(HardGrowth, AlloysAndSpacings) {
  const double side = DIM == 2 ? 64 : 32, time = DIM == 2 ? 15 : 3;
  const std::vector<std::vector<std::string>> alloys = {
      {"alloy.W0_over_d0=3.61", "alloy.supersaturation=0.8"},
      {"alloy.W0_over_d0=30", "alloy.supersaturation=0.5"},
      {"alloy.W0_over_d0=1", "alloy.supersaturation=0.95"},
      {"alloy.partition_coefficient=0.01"},
      {"alloy.partition_coefficient=0.95"},
      {"phase_field.anisotropy=0.06", "alloy.W0_over_d0=1.84"},
      {"phase_field.anisotropy=0"},
      {"solute.antitrapping=none"},
      {"phase_field.noise=0.5"},
  };
  for (const double dx : DIM == 2 ? std::vector<double>{0.5, 1.0, 1.6} : std::vector<double>{1.0, 1.6}) {
    for (const std::vector<std::string>& overrides : alloys) {
      Scene scene(corner_crystal(side, dx), overrides);
      scene.advance_to(time);
      expect_sound(scene, overrides[0] + " dx " + std::to_string(dx));
    }
  }
}

TEST(HardGrowth, TinySeedDissolves) {
  Scene scene(corner_crystal(DIM == 2 ? 64 : 32, 1.0), {"seed[0].radius_W0=1.5", "alloy.supersaturation=0.05"});
  scene.advance_to(20);
  expect_sound(scene, "tiny seed");
  EXPECT_TRUE(scene->tips().empty());
}

TEST(HardGrowth, SeedOverTheWholeBox) {
  Scene scene(corner_crystal(32, 1.0), {"seed[0].radius_W0=500"});
  scene.advance_to(5);
  expect_sound(scene, "solid box");
  EXPECT_NEAR(scene->totals().solid_fraction, 1, 1e-9);
}

TEST(HardGrowth, SeedsThatTouchAndSeedAtAWall) {
  std::string two = whole_crystal(64, DIM == 2 ? 1.0 : 2.0);
  two += "[[seed]]\nposition_W0 = " + vector_text(19) + "\nradius_W0 = 9\n";
  two += "[[seed]]\nposition_W0 = " + vector_text(1) + "\nradius_W0 = 6\n";
  for (const char* sides : {"wall", "periodic"}) {
    std::vector<std::string> overrides;
    for (const char* face : {"xlo", "xhi", "ylo", "yhi"}) overrides.push_back(std::string("mesh.") + face + "=" + sides);
    Scene scene(two, overrides);
    scene.advance_to(DIM == 2 ? 20 : 4);
    expect_sound(scene, sides);
  }
}

TEST(HardGrowth, ManyLevels) {
  // The domain is 2^9 times the block that holds the crystal in 2D.
  Scene scene(corner_crystal(DIM == 2 ? 8192 : 512, 1.0));
  ASSERT_GE(scene->mesh().shape().max_level, DIM == 2 ? 9 : 5);
  scene.advance_to(5);
  expect_sound(scene, "many levels");
}

TEST(HardGrowth, FastDriftAcrossTheMesh) {
  const std::string flow = std::string("[flow]\nvelocity_W0_tau0 = [5, -3") + (DIM == 3 ? ", 2]\n" : "]\n");
  Scene scene(whole_crystal(64, DIM == 2 ? 1.0 : 2.0, flow));
  scene.advance_to(DIM == 2 ? 20 : 4);
  expect_sound(scene, "fast drift");
}

}  // namespace
}  // namespace dendrift::test

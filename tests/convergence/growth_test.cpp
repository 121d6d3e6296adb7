// Growth against the reference values of docs/verification.md, on short runs; tools/verify.py has the long ones.
#include <gtest/gtest.h>

#include "support/scene.hpp"

namespace dendrift::test {
namespace {

// Position of the tip on the first axis.
double tip(Scene& scene) { return scene->tips().at(0).length; }

TEST(Growth, TipOfTheFreeCrystal) {
  // Row 1 (2D, t = 100: 21.56) and row 2 (3D, t = 25: 16.77) of the reference, both to .3 %.
  Scene scene(corner_crystal(DIM == 2 ? 256 : 96, DIM == 2 ? 1.0 : 1.5));
  scene.advance_to(DIM == 2 ? 100 : 25);
  const double expected = DIM == 2 ? 21.56 : 16.77;
  EXPECT_NEAR(tip(scene), expected, 0.005 * expected);
  EXPECT_LT(std::abs(scene->solute_drift(scene->totals())), 1e-13);
}

TEST(Growth, AdaptiveMeshEqualsUniformMesh) {
  const double side = DIM == 2 ? 128 : 64, dx = DIM == 2 ? 1 : 1.0;
  const int blocks = static_cast<int>(side / dx) / 16;
  const std::string roots = DIM == 2 ? "[" + std::to_string(blocks) + "," + std::to_string(blocks) + "]"
                                     : "[" + std::to_string(blocks) + "," + std::to_string(blocks) + "," +
                                           std::to_string(blocks) + "]";
  Scene adaptive(corner_crystal(side, dx));
  Scene uniform(corner_crystal(side, dx), {"mesh.root_blocks=" + roots, "mesh.levels=1"});
  ASSERT_LT(adaptive->totals().blocks, uniform->totals().blocks);
  for (Scene* s : {&adaptive, &uniform}) s->advance_to(DIM == 2 ? 40 : 8);
  EXPECT_NEAR(tip(adaptive), tip(uniform), 1e-3 * tip(uniform));
}

TEST(Growth, ArmsOfOneCrystalAreEqual) {
  Scene scene(whole_crystal(DIM == 2 ? 128 : 64, DIM == 2 ? 1.0 : 2.0));
  scene.advance_to(DIM == 2 ? 40 : 6);
  const std::vector<physics::Tip> tips = scene->tips();
  ASSERT_EQ(tips.size(), 2U * DIM);
  for (const physics::Tip& t : tips) EXPECT_NEAR(t.length, tips[0].length, 1e-10);
}

TEST(Growth, TimeStepErrorIsSmall) {
  if (DIM == 3) return;  // the same code, and dear
  Scene large(corner_crystal(128, 1.0)), small(corner_crystal(128, 1.0), {"phase_field.max_dt_tau0=0.04"});
  for (Scene* s : {&large, &small}) s->advance_to(40);
  EXPECT_NEAR(tip(large), tip(small), 3e-4 * tip(small));
}

}  // namespace
}  // namespace dendrift::test

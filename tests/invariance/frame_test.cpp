// What must not matter: the crystal's angle to the mesh, and a uniform drift.
#include <gtest/gtest.h>

#include "support/scene.hpp"

namespace dendrift::test {
namespace {

TEST(Frame, TurnedCrystalsGrowAlike) {
  if (DIM == 3) {  // a quarter turn about z: exact in the mesh's own symmetry
    Scene plain(whole_crystal(64, 2.0)), turned(whole_crystal(64, 2.0, "angle_deg = 45\n"));
    for (Scene* s : {&plain, &turned}) s->advance_to(6);
    EXPECT_NEAR(plain->tips().at(0).length, turned->tips().at(0).length, 0.03 * plain->tips().at(0).length);
    return;
  }
  double first = 0;
  for (const char* angle : {"0", "15", "30", "45"}) {
    Scene scene(whole_crystal(192, 1.0, std::string("angle_deg = ") + angle + "\n"));
    scene.advance_to(60);
    for (const physics::Tip& t : scene->tips()) {
      if (first == 0) first = t.length;
      EXPECT_NEAR(t.length, first, 0.005 * first) << angle;
      EXPECT_LT(std::abs(t.off_axis_deg), 0.2) << angle;
    }
  }
}

TEST(Frame, DriftingCrystalGrowsLikeOneAtRest) {
  const double side = DIM == 2 ? 128 : 64, dx = DIM == 2 ? 1.0 : 1.5, time = DIM == 2 ? 50 : 8;
  const std::string flow = std::string("[flow]\nvelocity_W0_tau0 = [0.5, 0.2") + (DIM == 3 ? ", 0.1]\n" : "]\n");
  Scene rest(whole_crystal(side, dx)), drift(whole_crystal(side, dx, flow)),
      printed(whole_crystal(side, dx, flow + "[solute]\nantitrapping = \"eulerian\"\n"));
  for (Scene* s : {&rest, &drift, &printed}) s->advance_to(time);
  const double expected = rest->tips().at(0).length;
  for (const physics::Tip& t : drift->tips()) EXPECT_NEAR(t.length, expected, 0.01 * expected) << t.arm;
  EXPECT_LT(std::abs(drift->solute_drift(drift->totals())), 1e-13);
  // The printed current is not Galilean invariant: the leading tip runs ahead. If it does not, the option is dead.
  EXPECT_GT(printed->tips().at(0).length, (DIM == 2 ? 1.03 : 1.005) * expected);
}

TEST(Frame, FrozenCrystalIsOnlyCarried) {
  const double side = DIM == 2 ? 128 : 64, dx = 1.0, time = DIM == 2 ? 256 : 64;  // once across the box along x
  const std::string text = whole_crystal(side, dx,
                                         std::string("[flow]\nvelocity_W0_tau0 = [") + (DIM == 2 ? "0.5, 0.25]\n" : "1.0, 0.5, 0.5]\n") +
                                             "[phase_field]\nfrozen = true\n");
  Scene scene(text);
  const Totals before = scene->totals();
  scene.advance_to(time);
  const Totals after = scene->totals();
  EXPECT_LT(std::abs(scene->solute_drift(after)), 1e-13);
  EXPECT_NEAR(after.solid_fraction, before.solid_fraction, 0.01 * before.solid_fraction);
  const std::vector<physics::Tip> tips = scene->tips();
  ASSERT_EQ(tips.size(), 2U * DIM);
  for (const physics::Tip& t : tips) EXPECT_NEAR(t.length, 10, 0.1) << t.arm;
}

}  // namespace
}  // namespace dendrift::test

// Crystals that meet: they neither pass through each other nor stop the clock, come to rest in a heap, part again if pulled
// apart, and move as one where they have grown together.
#include <fmt/format.h>
#include <gtest/gtest.h>

#include <cmath>

#include "support/scene.hpp"

namespace dendrift::test {
namespace {

#if DENDRIFT_DIM == 2

std::string scene_text(const std::string& size, const std::string& seeds, const std::string& flow, bool rigid) {
  return fmt::format(
      "[run]\nend_time_tau0 = 100000\n[mesh]\ndim = 2\nsize_W0 = {}\ndx_W0 = 1\nblock_cells = 8\n{}[phase_field]\nfrozen = true\n"
      "rigid = {}\n[alloy]\nviscosity_um2_s = 5e4\n[flow]\nsolutal_buoyancy = false\n{}",
      size, seeds, rigid ? "true" : "false", flow);
}

std::string disc(double x, double y, double radius, double angle = 0) {
  return fmt::format("[[seed]]\nposition_W0 = [{}, {}]\nradius_W0 = {}\nangle_deg = {}\n", x, y, radius, angle);
}

double distance(const physics::Seed& a, const physics::Seed& b) {
  return std::hypot(a.position[0] - b.position[0], a.position[1] - b.position[1]);
}

// Interfaces are some 2.8 W0 wide: crystals that overlap by less have met with their skins only.
constexpr double SKIN = 1.5;

TEST(Contact, DiscsPileUpAndComeToRest) {
  Scene scene(scene_text("[64, 64]", disc(32, 12, 8) + disc(33, 32, 8, 20), "gravity_um_s2 = 1e9\n", true));
  const auto crystals = [&]() -> const std::vector<physics::Seed>& { return scene->crystals(); };
  double overlap = -1e300, floor = -1e300, shortest = 1e300, fastest = 0;
  int steps = 0, contacts = 0;
  while (scene->time() < 100 && steps < 1000) {
    const double before = scene->time();
    scene->step(scene->max_dt());
    ++steps;
    shortest = std::min(shortest, scene->time() - before);
    for (std::size_t i = 0; i < 2; ++i) {
      floor = std::max(floor, 8 - crystals()[i].position[1]);
      fastest = std::max(fastest, -crystals()[i].velocity[1]);
      contacts = std::max(contacts, crystals()[i].contacts);
      for (std::size_t j = 0; j < i; ++j) overlap = std::max(overlap, 16 - distance(crystals()[i], crystals()[j]));
    }
  }
  EXPECT_LT(steps, 1000);
  EXPECT_GT(shortest, 0.05);
  EXPECT_GT(overlap, 0);  // they have met
  EXPECT_LT(overlap, SKIN);
  EXPECT_LT(floor, SKIN);
  EXPECT_GT(fastest, 0.1);
  EXPECT_GE(contacts, 1);
  for (const physics::Seed& g : crystals()) EXPECT_LT(std::abs(g.velocity[1]), 0.2 * fastest);
}

// A heap of three discs that all but touch: what the tolerance says of the velocity is said of each crystal as well, at a
// bounded cost. Without the rigid motions of crystals in the preconditioner, 1e-5 left these velocities wrong by percents.
TEST(Contact, CrystalsInAHeapAreAsRightAsTheMelt) {
  const auto solve = [](double tolerance) {
    Scene scene(scene_text("[64, 64]", disc(20, 12, 9) + disc(41, 12, 9) + disc(30, 30, 9) + disc(52, 26, 7),
                           fmt::format("gravity_um_s2 = 1e8\ntolerance = {}\n", tolerance), true));
    scene->step(0.1);
    scene->step(0.1);
    return std::pair{scene->crystals(), scene->report().flow_iterations};
  };
  const auto [rough, few] = solve(1e-5);
  const auto [fine, many] = solve(1e-8);
  EXPECT_LT(few, 70);
  EXPECT_LT(many, 120);
  double fastest = 0;
  for (const physics::Seed& g : fine) fastest = std::max(fastest, std::hypot(g.velocity[0], g.velocity[1]));
  EXPECT_GT(fastest, 1e-3);
  for (std::size_t g = 0; g < fine.size(); ++g) {
    const double wrong = std::hypot(rough[g].velocity[0] - fine[g].velocity[0], rough[g].velocity[1] - fine[g].velocity[1]);
    EXPECT_LT(wrong, 1e-3 * fastest) << g;
    EXPECT_LT(9 * std::abs(rough[g].spin[2] - fine[g].spin[2]), 1e-3 * fastest) << g;
  }
}

// Two discs in touch in a melt that stretches along x and yields along y.
TEST(Contact, CrystalsPartAgain) {
  Scene scene(scene_text("[96, 64]", disc(39.8, 32, 8) + disc(56.2, 32, 8, 30), "gravity_um_s2 = 0\nwall_gradient_per_tau0 = [0.05, 0, 0, -0.05]\n",
                         true));
  scene.advance_to(2);
  EXPECT_TRUE(scene->crystals()[1].touching);
  const double before = distance(scene->crystals()[0], scene->crystals()[1]);
  scene.advance_to(40);
  EXPECT_GT(distance(scene->crystals()[0], scene->crystals()[1]), before + 4);
  EXPECT_FALSE(scene->crystals()[0].touching);
  EXPECT_FALSE(scene->crystals()[1].touching);
}

// A large disc and a small one, one solid: it turns and falls as one, whatever the labels say. Two that have only come close
// do not.
TEST(Contact, JoinedCrystalsMoveAsOne) {
  for (const bool joined : {true, false}) {
    const double apart = joined ? 14 : 23;
    Scene scene(scene_text("[96, 96]", disc(40, 60, 12) + disc(40 + apart, 60, 6, 30), "gravity_um_s2 = 1e8\n", false));
    scene.advance_to(2);
    const physics::Seed &a = scene->crystals()[0], &b = scene->crystals()[1];
    const double rx = b.position[0] - a.position[0], ry = b.position[1] - a.position[1];
    const double slip = std::hypot(b.velocity[0] - a.velocity[0] + a.spin[2] * ry, b.velocity[1] - a.velocity[1] - a.spin[2] * rx);
    const double speed = std::hypot(a.velocity[0], a.velocity[1]);
    if (joined) {
      EXPECT_EQ(a.contacts, 1);
      EXPECT_LT(slip, 1e-3 * speed);
      EXPECT_NEAR(a.spin[2], b.spin[2], 0.03 * std::abs(a.spin[2]));  // the neck bends a little
    } else {
      EXPECT_EQ(a.contacts, 0);
      EXPECT_GT(slip, 0.05 * speed);
    }
  }
}

#endif

}  // namespace
}  // namespace dendrift::test

// Hulls of crystals and the melt that each may stir.
#include <fmt/format.h>
#include <gtest/gtest.h>

#include <cmath>

#include "physics/whirls.hpp"
#include "support/scene.hpp"

namespace dendrift::test {
namespace {

RealVec filled_real(double x) {
  RealVec r;
  for (double& y : r) y = x;
  return r;
}

double norm(const RealVec& r) {
  double square = 0;
  for (const double x : r) square += x * x;
  return std::sqrt(square);
}

TEST(Directions, NodesGetTheirOwnValueAndConstantsStay) {
  const std::vector<RealVec>& nodes = physics::Directions::nodes();
  std::vector<double> values;
  for (std::size_t n = 0; n < nodes.size(); ++n) {
    EXPECT_NEAR(norm(nodes[n]), 1, 1e-15);
    values.push_back(std::sin(static_cast<double>(n)));
  }
  const std::vector<double> constant(nodes.size(), 3.5);
  for (std::size_t n = 0; n < nodes.size(); ++n) {
    RealVec r = nodes[n];
    for (double& x : r) x *= 7;
    EXPECT_NEAR(physics::Directions::value(values, r), values[n], 1e-12);
    for (int a = 0; a < DIM; ++a) r[a] += 0.1 * (a + 1);
    EXPECT_NEAR(physics::Directions::value(constant, r), 3.5, 1e-14);
  }
}

TEST(Directions, ContinuousOverCorners) {
  std::vector<double> values;
  for (const RealVec& r : physics::Directions::nodes()) values.push_back(r[0] + 2 * r[1]);
  RealVec r = filled_real(1.0), beyond = r;
  for (int a = 0; a < DIM; ++a) {
    beyond = r;
    beyond[a] += 1e-9;
    EXPECT_NEAR(physics::Directions::value(values, beyond), physics::Directions::value(values, r), 1e-7);
  }
}

// Two round crystals, 12 W0 between them, in a box whose walls are far from their sides that look away.
TEST(Whirls, HoldTheSolidAndShareTheMelt) {
  const double radius = 8, gap = 12, side = 96, middle = side / 2;
  std::string text = fmt::format("[run]\nend_time_tau0 = 1\n[mesh]\ndim = {}\nsize_W0 = {}\ndx_W0 = 1\n[phase_field]\nfrozen = true\n", DIM,
                                 vector_text(side));
  for (const double sign : {-1.0, 1.0}) {
    std::string place = fmt::format("[{}", middle + sign * (radius + gap / 2));
    for (int a = 1; a < DIM; ++a) place += fmt::format(", {}", middle);
    text += fmt::format("[[seed]]\nposition_W0 = {}]\nradius_W0 = {}\n", place, radius);
  }
  Scene scene(text);
  amr::Mesh& mesh = scene->mesh();
  const physics::Neighbourhood found = physics::find_neighbourhood(mesh, scene->field("psi"), {-1}, scene->crystals());
  const std::vector<physics::Whirl>& whirls = found.whirls;
  EXPECT_EQ(found.body, (std::vector<int>{0, 1}));
  ASSERT_EQ(whirls.size(), 2u);
  const std::vector<RealVec>& nodes = physics::Directions::nodes();
  for (const physics::Whirl& w : whirls) {
    const double towards = w.centre[0] < middle ? 1 : -1;
    for (std::size_t n = 0; n < nodes.size(); ++n) {
      EXPECT_GT(w.radius[n], radius + 0.5);  // the interface has its viscosity, too
      EXPECT_LT(w.radius[n], radius + 4);
      EXPECT_GE(w.reach[n], w.radius[n] + 2);
      EXPECT_LE(w.reach[n], 4 * (radius + 4));
      const double x = w.centre[0] + nodes[n][0] * w.reach[n];
      EXPECT_LT(towards * (x - middle), 1.0) << nodes[n][0];  // not beyond half way
      if (towards * nodes[n][0] > 0.999) {
        EXPECT_NEAR(w.reach[n], radius + gap / 2, 1.5);
      } else if (towards * nodes[n][0] < -0.9) {
        EXPECT_GT(w.reach[n], 2.5 * radius);
      }
    }
  }
}

// Numbers 0 and 2 are frozen together, 3 to a wall, 4 to 3, and 1 stands 4 W0 from 0.
TEST(Neighbourhood, KnowsWhatIsFrozenTogether) {
  std::string text = fmt::format("[run]\nend_time_tau0 = 1\n[mesh]\ndim = {}\nsize_W0 = {}\ndx_W0 = 1\n[phase_field]\nfrozen = true\n", DIM,
                                 vector_text(64));
  for (const auto& [x, y] : {std::pair{20.0, 40.0}, {40.0, 40.0}, {20.0, 25.0}, {57.0, 20.0}, {43.0, 20.0}}) {
    text += fmt::format("[[seed]]\nposition_W0 = [{}, {}{}]\nradius_W0 = 8\n", x, y, DIM == 3 ? ", 32" : "");
  }
  Scene scene(text);
  const physics::Neighbourhood found = physics::find_neighbourhood(scene->mesh(), scene->field("psi"), {-1}, scene->crystals());
  EXPECT_EQ(found.body, (std::vector<int>{0, 1, 0, -1, -1}));
}

}  // namespace
}  // namespace dendrift::test

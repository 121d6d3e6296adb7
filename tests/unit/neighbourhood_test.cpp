// Where crystals stand, and whom the melt between them follows.
#include "physics/neighbourhood.hpp"

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <cmath>

#include "support/scene.hpp"

namespace dendrift::test {
namespace {

using physics::Corners;
using physics::Neighbourhood;

std::string box(double side) {
  return fmt::format("[run]\nend_time_tau0 = 1\n[mesh]\ndim = {}\nsize_W0 = {}\ndx_W0 = 1\n[phase_field]\nfrozen = true\n", DIM,
                     vector_text(side));
}

Neighbourhood find(Scene& scene) {
  return physics::find_neighbourhood(scene->mesh(), scene->field("psi"), {-1}, scene->crystals());
}

// Calls f(place, parts of all crystals) for all corners.
template <class F>
void for_each_corner(const amr::Mesh& mesh, const Neighbourhood& n, F&& f) {
  const Corners corners{mesh.layout().n};
  for (int b = 0; b < mesh.size(); ++b)
    amr::for_each_cell(filled(-1), filled(corners.pitch()), [&](const IntVec& q) {
      RealVec x = mesh.block(b).lo;
      for (int a = 0; a < DIM; ++a) x[a] += q[a] * mesh.block(b).dx;
      std::vector<double> parts(n.crystals.size(), 0.0);
      for (const Neighbourhood::Share& s : n.shares[static_cast<std::size_t>(b)])
        parts[static_cast<std::size_t>(s.crystal)] = s.part[static_cast<std::size_t>(corners.offset(q))];
      f(x, parts);
    });
}

// Two round crystals, 6 W0 between them, in a box whose walls are far from their sides that look away.
TEST(Neighbourhood, MeltFollowsTheCrystalsAroundIt) {
  const double radius = 8, gap = 6, side = 96, middle = side / 2;
  std::string text = box(side);
  for (const double sign : {-1.0, 1.0}) {
    std::string place = fmt::format("[{}", middle + sign * (radius + gap / 2));
    for (int a = 1; a < DIM; ++a) place += fmt::format(", {}", middle);
    text += fmt::format("[[seed]]\nposition_W0 = {}]\nradius_W0 = {}\n", place, radius);
  }
  Scene scene(text);
  const Neighbourhood n = find(scene);
  EXPECT_EQ(n.body, (std::vector<int>{0, 1}));
  for (const Neighbourhood::Crystal& c : n.crystals) {
    EXPECT_NEAR(c.radius, radius, 0.8);
    EXPECT_NEAR(c.gap, gap, 0.8);
  }
  double least = 1;  // of the sum in the gap
  for_each_corner(scene->mesh(), n, [&](const RealVec& x, const std::vector<double>& parts) {
    double beside = 0;
    for (int a = 1; a < DIM; ++a) beside += std::pow(x[a] - middle, 2);
    std::array<double, 2> distance;
    for (std::size_t k = 0; k < 2; ++k) distance[k] = std::sqrt(std::pow(x[0] - n.crystals[k].centre[0], 2) + beside) - radius;
    for (std::size_t k = 0; k < 2; ++k) {
      EXPECT_GE(parts[k], 0);
      if (distance[k] < -1) {
        EXPECT_EQ(parts[k], 1);
      }
      if (distance[1 - k] < -1) {
        EXPECT_EQ(parts[k], 0);
      }
      if (distance[k] > 2.2 * radius) {
        EXPECT_LT(parts[k], 1e-6);
      }
    }
    EXPECT_LE(parts[0] + parts[1], 1 + 1e-12);
    if (std::abs(x[0] - middle) < gap / 2 && beside < 1) least = std::min(least, parts[0] + parts[1]);
    if (std::abs(x[0] - middle) < 1e-9 && beside < 9) {
      EXPECT_NEAR(parts[0], parts[1], 0.1);
    }
    for (int a = 0; a < DIM; ++a)
      if (x[a] < 1e-9 || x[a] > side - 1e-9) {
        EXPECT_LT(parts[0] + parts[1], 1e-6);
      }
  });
  EXPECT_GT(least, 0.85);
}

// Without walls, seen through a periodic side as well.
TEST(Neighbourhood, ThroughPeriodicSides) {
  std::string text = box(64);
  for (const char* face : {"xlo", "xhi"}) text = text.insert(text.find("[phase_field]"), fmt::format("{} = \"periodic\"\n", face));
  const std::string more = DIM == 3 ? ", 32" : "";
  Scene scene(text + fmt::format("[[seed]]\nposition_W0 = [4, 32{0}]\nradius_W0 = 8\n[[seed]]\nposition_W0 = [46, 32{0}]\nradius_W0 = 8\n", more));
  const Neighbourhood n = find(scene);
  EXPECT_EQ(n.body, (std::vector<int>{0, 1}));
  EXPECT_NEAR(n.crystals[0].radius, 8, 0.8);
  EXPECT_NEAR(n.crystals[0].gap, 6, 0.8);
  for_each_corner(scene->mesh(), n, [&](const RealVec& x, const std::vector<double>& parts) {
    const double away = std::abs(x[0] - (x[0] > 36 ? 68 : 4));
    if (away < 6 && std::abs(x[1] - 32) < 1 && (DIM == 2 || std::abs(x[DIM - 1] - 32) < 1)) {
      EXPECT_EQ(parts[0], 1) << x[0];
    }
  });
}

// Numbers 0 and 2 are frozen together, 3 to a wall, 4 to 3, and 1 stands 4 W0 from 0.
TEST(Neighbourhood, KnowsWhatIsFrozenTogether) {
  std::string text = box(64);
  for (const auto& [x, y] : {std::pair{20.0, 40.0}, {40.0, 40.0}, {20.0, 25.0}, {57.0, 20.0}, {43.0, 20.0}}) {
    text += fmt::format("[[seed]]\nposition_W0 = [{}, {}{}]\nradius_W0 = 8\n", x, y, DIM == 3 ? ", 32" : "");
  }
  Scene scene(text);
  EXPECT_EQ(find(scene).body, (std::vector<int>{0, 1, 0, -1, -1}));
}

}  // namespace
}  // namespace dendrift::test

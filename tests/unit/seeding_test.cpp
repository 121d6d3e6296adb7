// Seeds at random and from files: table [seeds].
#include "physics/seeding.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <random>

#include "settings.hpp"
#include "support/mesh_fixture.hpp"

namespace dendrift::test {
namespace {

using physics::SeedOptions;
using physics::SeedingOptions;
using physics::SeedingProblem;

amr::MeshShape box(double side, bool periodic) {
  amr::MeshShape s;
  s.root_blocks = filled(4);
  s.block_cells = 16;
  s.root_dx = side / 64;
  s.sides.fill(periodic ? amr::Side::periodic : amr::Side::wall);
  return s;
}

SeedingOptions options(int count) {
  SeedingOptions o;
  o.count = count;
  o.radius_w0 = 10;
  return o;
}

double distance(const SeedOptions& a, const SeedOptions& b, double side, bool periodic) {
  double square = 0;
  for (int i = 0; i < DIM; ++i) {
    double r = (*a.position_w0)[i] - (*b.position_w0)[i];
    if (periodic) r -= side * std::round(r / side);
    square += r * r;
  }
  return std::sqrt(square);
}

TEST(Seeding, KeepsItsDistances) {
  for (const bool periodic : {false, true}) {
    const double side = 600;
    const auto seeds = options(40).at_random(box(side, periodic), physics::Scales(physics::AlloyOptions{}));
    ASSERT_EQ(seeds.size(), 40U);
    double near_side = side;
    for (std::size_t i = 0; i < seeds.size(); ++i) {
      for (std::size_t j = 0; j < i; ++j) EXPECT_GE(distance(seeds[i], seeds[j], side, periodic), 40);
      for (const double x : *seeds[i].position_w0) near_side = std::min({near_side, x, side - x});
    }
    EXPECT_EQ(near_side >= 30, !periodic);
  }
}

// Means of many: 40 seeds have a mean of .5 +- .09 of the side (two standard deviations), angles the same.
TEST(Seeding, IsUniformAndTurnsWithTheGenerator) {
  double x = 0, angle = 0;
  std::set<double> all;
  for (int generator = 1; generator <= 20; ++generator) {
    SeedingOptions o = options(20);
    o.generator = generator;
    o.last_time_tau0 = 100;
    const auto seeds = o.at_random(box(600, true), physics::Scales(physics::AlloyOptions{}));
    const auto again = o.at_random(box(600, true), physics::Scales(physics::AlloyOptions{}));
    for (std::size_t i = 0; i < seeds.size(); ++i) {
      EXPECT_EQ(*seeds[i].position_w0, *again[i].position_w0);
      EXPECT_EQ(seeds[i].angle_deg, again[i].angle_deg);
      x += (*seeds[i].position_w0)[0] / 600 / 400;
      angle += (DIM == 2 ? seeds[i].angle_deg / 90 : seeds[i].euler_deg[0] / 360) / 400;
      all.insert((*seeds[i].position_w0)[0]);
      EXPECT_GE(*seeds[i].nucleation_time_tau0, 0);
      EXPECT_LT(*seeds[i].nucleation_time_tau0, 100);
    }
  }
  EXPECT_NEAR(x, 0.5, 0.04);  // three standard deviations
  EXPECT_NEAR(angle, 0.5, 0.045);
  EXPECT_EQ(all.size(), 400U);
}

TEST(Seeding, SaysWhenThereIsNoRoom) {
  try {
    options(400).at_random(box(200, false), physics::Scales(physics::AlloyOptions{}));
    FAIL();
  } catch (const SeedingProblem& p) {
    EXPECT_EQ(p.key, "seeds.count");
  }
  SeedingOptions o = options(1);
  o.clearance_w0 = 100;
  EXPECT_THROW(o.at_random(box(200, false), physics::Scales(physics::AlloyOptions{})), SeedingProblem);
}

// Places in balls of many sizes, circles, rings and ellipses, some not there: the deepest of all is always listed, and far fewer
// than all are.
TEST(Deepest, ListsTheDeepestOfEveryPlaceInABall) {
  constexpr double SIDE = 600;
  for (const bool periodic : {false, true}) {
    const amr::MeshShape shape = box(SIDE, periodic);
    std::vector<SeedOptions> list = options(40).at_random(shape, physics::Scales(physics::AlloyOptions{}));
    for (std::size_t i = 0; i < list.size(); ++i) {
      list[i].aspect_ratio = i % 3 == 0 ? 1.0 : 0.3 + 0.1 * static_cast<double>(i);
      if (i % 6 == 0) list[i].inner_radius_w0 = 7;
    }
    std::vector<physics::Seed> crystals = physics::make_seeds(list, physics::Scales(physics::AlloyOptions{}));
    for (std::size_t i = 0; i < crystals.size(); i += 7) crystals[i].present = false;
    std::mt19937_64 generator(7);
    std::uniform_real_distribution<double> place(0, SIDE), within(-1, 1);
    std::size_t listed = 0;
    constexpr int BALLS = 2000;
    for (int ball = 0; ball < BALLS; ++ball) {
      const double radius = std::array{0.0, 2.0, 5.0, 60.0}[static_cast<std::size_t>(ball % 4)];
      RealVec middle;
      for (double& x : middle) x = place(generator);
      const std::vector<std::size_t> near = physics::deepest(crystals, shape, middle, radius);
      listed += near.size();
      for (const std::size_t g : near) EXPECT_TRUE(crystals[g].present);
      for (int point = 0; point < 20; ++point) {
        RealVec x = middle;
        for (double& a : x) a += radius / std::sqrt(double{DIM}) * within(generator);
        double most = -1e300;
        std::size_t first = 0;
        for (std::size_t g = 0; g < crystals.size(); ++g) {
          const double depth = crystals[g].depth(shape.way(crystals[g].position, x));
          if (!crystals[g].present || depth <= most) continue;
          most = depth;
          first = g;
        }
        EXPECT_TRUE(std::ranges::find(near, first) != near.end()) << "ball " << ball << ", crystal " << first;
      }
    }
    EXPECT_LT(listed, BALLS * crystals.size() / 3);
  }
}

class SeedFile : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::temp_directory_path() / ("dendrift_seeds_" + std::to_string(::getpid()) + "_" + std::to_string(DIM));
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }
  std::vector<SeedOptions> read(const std::string& text) {
    std::ofstream(folder_ / "seeds.csv") << text;
    SeedingOptions o;
    o.file = "seeds.csv";
    return o.from_file(folder_.string(), physics::Scales(physics::AlloyOptions{}));
  }
  std::string problem(const std::string& text) {
    try {
      read(text);
    } catch (const SeedingProblem& p) {
      return p.expected + " | " + p.found;
    }
    return "none";
  }
  std::filesystem::path folder_;
};

const std::string XYZ = DIM == 2 ? "x_um,y_um" : "x_um,y_um,z_um", POINT = DIM == 2 ? "1,2" : "1,2,3";

TEST_F(SeedFile, RowsBecomeSeeds) {
  const std::string angle = DIM == 2 ? "angle_deg" : "euler2_deg";
  const auto seeds = read("# crystals\n" + XYZ + ", radius_W0 ," + angle + ",held,nucleation_time_s\n\n" + POINT + ",10,30,1,0.5\r\n" +
                          POINT + ",1e1,-4.5,0,0\n");
  ASSERT_EQ(seeds.size(), 2U);
  EXPECT_EQ((*seeds[0].position_um)[1], 2);
  EXPECT_EQ(*seeds[0].radius_w0, 10);
  EXPECT_EQ(DIM == 2 ? seeds[0].angle_deg : seeds[0].euler_deg[1], 30);
  EXPECT_TRUE(seeds[0].held);
  EXPECT_EQ(*seeds[0].nucleation_time_s, 0.5);
  EXPECT_EQ(DIM == 2 ? seeds[1].angle_deg : seeds[1].euler_deg[1], -4.5);
  EXPECT_FALSE(seeds[1].held);
}

TEST_F(SeedFile, MistakesAreNamedWithTheirLine) {
  const std::string head = XYZ + ",radius_um\n";
  const auto mentions = [](const std::string& text, std::initializer_list<const char*> words) {
    return std::ranges::all_of(words, [&](const char* w) { return text.find(w) != std::string::npos; });
  };
  EXPECT_TRUE(mentions(problem(head + POINT + ",1\n" + POINT + "\n"), {"seeds.csv:3", "fields"}));
  EXPECT_TRUE(mentions(problem(head + POINT + ",x\n"), {"seeds.csv:2", "number", "radius_um", "| x"}));
  EXPECT_TRUE(mentions(problem(head + POINT + ",nan\n"), {"number", "nan"}));
  EXPECT_TRUE(mentions(problem(head + POINT + ",-1\n"), {"radius > 0", "-1"}));
  EXPECT_TRUE(mentions(problem(head + POINT + ",\n"), {"nothing"}));
  EXPECT_TRUE(mentions(problem("x_um,radius_um\n1,2\n"), {"coordinates"}));
  EXPECT_TRUE(mentions(problem(XYZ + "\n" + POINT + "\n"), {"exactly one of the columns radius_um"}));
  EXPECT_TRUE(mentions(problem(XYZ + ",radius_um,colour\n"), {"columns among", "colour"}));
  EXPECT_TRUE(mentions(problem(XYZ + ",radius_um,radius_um\n"), {"each once"}));
  EXPECT_TRUE(mentions(problem(head.substr(0, head.size() - 1) + ",held\n" + POINT + ",1,2\n"), {"0 or 1"}));
  EXPECT_TRUE(mentions(problem(head.substr(0, head.size() - 1) + ",nucleation_time_s\n" + POINT + ",1,1e308\n"), {"seeds.csv:2", "finite in tau0"}));
  EXPECT_TRUE(mentions(problem(""), {"empty file"}));
  SeedingOptions o;
  o.file = "none.csv";
  EXPECT_THROW(o.from_file(folder_.string(), physics::Scales(physics::AlloyOptions{})), SeedingProblem);
}

}  // namespace
}  // namespace dendrift::test

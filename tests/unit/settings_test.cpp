#include "settings.hpp"

#include <gtest/gtest.h>

#include "memory.hpp"

namespace dendrift {
namespace {

amr::MeshShape shape_of(double x, double y, double dx) {
  MeshOptions o;
  o.block_cells = 16;
  o.dx_w0 = dx;
  RealVec size{};
  size.fill(y);
  size[0] = x;
  return choose_shape(size, o);
}

TEST(ChooseShape, KeepsTheSpacingWhereBlocksFit) {
  const amr::MeshShape s = shape_of(1024, 1024, 1);
  EXPECT_EQ(s.max_level, 6);
  EXPECT_EQ(s.root_blocks[0], 1);
  EXPECT_DOUBLE_EQ(s.dx(s.max_level), 1);
}

TEST(ChooseShape, PrefersADeepTreeToTheSpacing) {
  // 128 = 2 blocks of 16 cells under two refinements at dx = 1, but 7 blocks of one level at 1.14.
  const amr::MeshShape s = shape_of(128, 128, 1.25);
  EXPECT_GE(s.max_level, 2);
  EXPECT_LE(s.dx(s.max_level), 1.25);
  EXPECT_GE(s.dx(s.max_level), 0.8 * 1.25 * (1 - 1e-9));
}

TEST(ChooseShape, CellsAreCubesAndNeverLargerThanAsked) {
  for (const double x : {30.0, 77.0, 128.0, 300.0, 1000.0, 4000.0})
    for (const double ratio : {1.0, 0.5, 2.0, 1.75, 0.2})
      for (const double dx : {0.3, 0.8, 1.0, 1.6}) {
        const amr::MeshShape s = shape_of(x, x * ratio, dx);
        const double finest = s.dx(s.max_level);
        EXPECT_LE(finest, dx * (1 + 1e-9)) << x << " " << ratio << " " << dx;
        for (int a = 0; a < DIM; ++a)
          EXPECT_NEAR(s.root_dx * s.block_cells * s.root_blocks[a], a == 0 ? x : x * ratio, 1e-6 * x);
      }
}

TEST(ChooseShape, RefusesSidesThatNoCubesTile) {
  EXPECT_THROW(shape_of(100, 100 * 3.14159265, 1), std::invalid_argument);
}

TEST(ChooseShape, RefusesBoxesBeyondTheKeysOfTheTree) {
  EXPECT_THROW(shape_of(1e300, 1e300, 1), std::invalid_argument);
  EXPECT_THROW(shape_of(16, 1e12, 1), std::invalid_argument);
  EXPECT_THROW(shape_of(1e12, 16, 1), std::invalid_argument);
}

// The issue of an input whose mesh is absurd.
std::string problem_of(const std::string& size, const std::string& roots, int levels) {
  const auto vector = [](const std::string& x) {
    return "[" + x + ", 1" + (DIM == 3 ? ", 1]" : "]");
  };
  Settings settings;
  try {
    settings.parse_text("run.end_time_tau0 = 1\nmesh.dim = " + std::to_string(DIM) + "\nmesh.size_W0 = " + vector(size) +
                            "\nmesh.root_blocks = " + vector(roots) + "\nmesh.levels = " + std::to_string(levels) +
                            "\n[[seed]]\nposition_W0 = " + vector("1") + "\nradius_W0 = 8\n",
                        "test", {});
  } catch (const io::InputError& e) {
    EXPECT_EQ(e.issues().size(), 1) << e.what();
    return e.issues()[0].key;
  }
  return "";
}

TEST(Settings, RefuseTreesThatNoMachineHolds) {
  EXPECT_EQ(problem_of("1000000", "1000000", 1), "");
  EXPECT_EQ(problem_of("1000001", "1000001", 1), "mesh.root_blocks");
  const std::int64_t most = amr::Tree::MOST_ALONG_AXIS >> 15;
  EXPECT_EQ(problem_of(std::to_string(most), std::to_string(most), 16), "");
  EXPECT_EQ(problem_of(std::to_string(most + 1), std::to_string(most + 1), 16), "mesh.levels");
}

TEST(Memory, CountsFieldsAndTree) {
  const amr::Layout layout{16};
  const double one = bytes_of_rank(1, 1, 10, layout);
  EXPECT_GE(one, 10 * 8 * std::pow(20, DIM));
  EXPECT_LE(one, 10 * 8 * std::pow(20, DIM) + 500);
  // Two ranks share the fields, not the tree.
  EXPECT_GT(bytes_of_rank(1000, 2, 10, layout), 500 * one);
  EXPECT_LT(bytes_of_rank(1000, 2, 10, layout), 520 * one);
  amr::FieldTable fields;
  amr::FieldSpec f;
  f.name = "a";
  fields.add_cell(f);
  EXPECT_TRUE(memory_of_mesh(1, fields, layout, MPI_COMM_SELF).enough());
  const Memory much = memory_of_mesh(std::int64_t{1} << 40, fields, layout, MPI_COMM_SELF);
  EXPECT_FALSE(much.enough()) << much.needed << " of " << much.present;
}

}  // namespace
}  // namespace dendrift

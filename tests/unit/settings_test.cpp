#include "settings.hpp"

#include <gtest/gtest.h>

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

}  // namespace
}  // namespace dendrift

// The mesh without its finest level: which leaves it has, and what comes and goes.
#include "amr/coarser_mesh.hpp"

#include <gtest/gtest.h>

#include "support/mesh_fixture.hpp"

namespace dendrift::test {
namespace {

using namespace amr;

struct Rows {
  FieldTable table;
  CellField u;
  FaceField v;

  Rows() {
    FieldSpec spec;
    spec.name = "u";
    u = table.add_cell(spec);
    spec.name = "v";
    v = table.add_face(spec);
  }
  FieldList all() const { return {{u}, {v}}; }
};

// A linear velocity, so that both levels hold the same function exactly; u is quadratic in its means.
struct Exact {
  Quadratic u;
  std::array<Quadratic, DIM> v;

  explicit Exact(Random& random) {
    const auto linear = [&](Quadratic& q) {
      q.constant = random.symmetric();
      for (double& x : q.linear) x = random.symmetric();
    };
    linear(u);
    for (int a = 0; a < DIM; ++a) {
      linear(v[static_cast<std::size_t>(a)]);
      for (int b = a; b < DIM; ++b) u.second[a][b] = random.symmetric();
    }
  }
  double cell(const Block& b, const IntVec& q) const { return u.mean(cell_centre(b, q), b.dx); }
  double face(const Block& b, int axis, const IntVec& q) const {
    RealVec x = cell_centre(b, q);
    x[axis] -= 0.5 * b.dx;
    return v[static_cast<std::size_t>(axis)].mean(x, b.dx);
  }
};

// f(array of local block b, its value at a place): for all arrays.
template <class F>
void for_values(const Rows& rows, Mesh& mesh, const Exact& exact, F&& f) {
  for (int b = 0; b < mesh.size(); ++b) {
    f(b, -1, mesh.cells(rows.u, b), [&, b](const IntVec& q) { return exact.cell(mesh.block(b), q); });
    for (int a = 0; a < DIM; ++a)
      f(b, a, mesh.faces(rows.v, a, b), [&, a, b](const IntVec& q) { return exact.face(mesh.block(b), a, q); });
  }
}

class MpiCoarserMesh : public ::testing::TestWithParam<Deal> {
 protected:
  // A tree that reaches its finest level in places, on all ranks alike.
  void make(Mesh& mesh, Random& random) const {
    const int finest = mesh.shape().max_level;
    Tree tree(mesh.shape().root_blocks, mesh.shape().periodic(), finest);
    for (int round = 0; round < finest; ++round) {
      std::vector<std::int8_t> change(static_cast<std::size_t>(tree.size()), 0);
      for (std::int8_t& c : change) c = random.chance(0.4) ? 1 : 0;
      change[static_cast<std::size_t>(random.below(tree.size()))] = 1;
      tree = tree.adapted(change);
    }
    put(mesh, tree, deal_out(GetParam(), tree, mesh.ranks(), random));
  }
};

TEST_P(MpiCoarserMesh, TakesMeansAndGivesWhatIsExactForPolynomials) {
  Random random(7);
  const Rows rows;
  std::int64_t children = 0;
  for (int round = 0; round < 6; ++round) {
    Mesh fine(shape_of(vec(2, 1, 1), axes(false, true, false), 1 + round % 3), rows.table, MPI_COMM_WORLD);
    make(fine, random);
    const Exact exact(random);
    CoarserMesh coarser(fine, rows.table);
    Mesh& coarse = coarser.mesh();
    const int n = fine.layout().n;
    const auto places = [&](int normal) {
      IntVec size = filled(n);
      if (normal >= 0) ++size[normal];
      return size;
    };
    for (const BlockIndex& b : coarse.tree().leaves()) ASSERT_LT(b.level, fine.shape().max_level);
    for (const BlockIndex& b : fine.tree().leaves()) {
      if (b.level < fine.shape().max_level) {
        ASSERT_GE(coarse.tree().find(b), 0) << text(b);
      }
    }
    for_values(rows, fine, exact, [&](int, int normal, double* x, auto&& value) {
      for_each_cell({}, places(normal), [&](const IntVec& q) { x[fine.layout().offset(q)] = value(q); });
    });
    coarser.take(rows.all());
    Tally tally;
    const auto check = [&](const char* what, Mesh& mesh) {
      for_values(rows, mesh, exact, [&](int b, int normal, const double* x, auto&& value) {
        for_each_cell({}, places(normal), [&](const IntVec& q) {
          tally.near(x[mesh.layout().offset(q)], value(q), 1e-12,
                     [&] { return what + text(mesh.block(b).index) + " cell " + text(q) + " axis " + std::to_string(normal); });
        });
      });
    };
    check("taken, ", coarse);
    // Something else in both, then back: what was given must be all there is.
    const Exact other(random);
    for_values(rows, coarse, other, [&](int, int, double* x, auto&& value) {
      for_all(coarse.layout(), [&](const IntVec& q) { x[coarse.layout().offset(q)] = value(q); });
    });
    coarser.give(rows.all());
    for_values(rows, fine, other, [&](int b, int normal, const double* x, auto&& value) {
      const bool common = fine.block(b).index.level < fine.shape().max_level;
      children += common ? 0 : 1;
      const IntVec lo = common ? filled(-Layout::GHOSTS) : IntVec{}, size = common ? filled(fine.layout().pitch()) : places(normal);
      for_each_cell(lo, size, [&](const IntVec& q) {
        tally.near(x[fine.layout().offset(q)], value(q), 1e-12,
                   [&] { return "given, " + text(fine.block(b).index) + " cell " + text(q) + " axis " + std::to_string(normal); });
      });
    });
    EXPECT_TRUE(tally.result());
  }
  EXPECT_GT(over_ranks(children, MPI_COMM_WORLD), 20);
}

INSTANTIATE_TEST_SUITE_P(Deals, MpiCoarserMesh, ::testing::ValuesIn(kDeals));

}  // namespace
}  // namespace dendrift::test

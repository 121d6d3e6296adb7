#include "amr/multigrid.hpp"

#include <gtest/gtest.h>

#include <numbers>

#include "support/mesh_fixture.hpp"

namespace dendrift::test {
namespace {

using amr::Component;

struct Case {
  bool coupled;  // the viscous operator of a vector, or one scalar in cells
  bool refined;
  int seed;
  double tolerance;
};

std::string name_of(const ::testing::TestParamInfo<Case>& info) {
  return std::string(info.param.coupled ? "Coupled" : "Cells") + (info.param.refined ? "Levels" : "") + std::to_string(info.param.seed);
}

class MultigridCycle : public ::testing::TestWithParam<Case> {};

// A random tree, random sides, a rough coefficient and a rough right-hand side, and all of it turned end for end along
// every axis: one cycle gives the same, turned. Where levels meet, means across a plane of faces take what the node above it makes of
// the plane below, with ghosts of its own: alike to third order only.
TEST_P(MultigridCycle, MirrorImagesAgree) {
  const bool coupled = GetParam().coupled;
  Random random(static_cast<unsigned>(GetParam().seed));
  const amr::MeshShape shape = shape_of(vec(4, 2, 2), axes(false, false, false), 2);
  const int n = shape.block_cells, components = coupled ? DIM : 1;
  const amr::Tree tree = random_tree(random, shape.root_blocks, shape.periodic(), 2, DIM == 2 ? 60 : 100, GetParam().refined ? 8 : 0);
  std::vector<Component> sides(static_cast<std::size_t>(components));
  for (int f = 0; f < FACES; ++f) {
    const bool wall = f == 0 || random.chance(0.4);  // no slip, or free
    for (int c = 0; c < components; ++c) {
      sides[static_cast<std::size_t>(c)].normal = coupled ? c : -1;
      sides[static_cast<std::size_t>(c)].sides[static_cast<std::size_t>(f)].odd = wall;
    }
  }
  struct Result {
    std::vector<amr::BlockIndex> leaves;
    std::vector<std::vector<double>> values;  // of a leaf, component by component
  };
  const auto cycle = [&](bool turned) {
    std::vector<amr::BlockIndex> leaves(tree.leaves().begin(), tree.leaves().end());
    std::vector<Component> list = sides;
    if (turned) {
      for (amr::BlockIndex& b : leaves)
        for (int a = 0; a < DIM; ++a) b.coord[a] = (shape.root_blocks[a] << b.level) - 1 - b.coord[a];
      for (std::size_t c = 0; c < list.size(); ++c)
        for (std::size_t f = 0; f < FACES; ++f) list[c].sides[f ^ 1] = sides[c].sides[f];
    }
    amr::Mesh mesh(shape, {}, MPI_COMM_SELF);
    put(mesh, amr::Tree(shape.root_blocks, shape.periodic(), 2, leaves), std::vector<int>(leaves.size(), 0));
    amr::Hierarchy h(mesh);
    // Number of a place in the box that is not turned, along one axis.
    const auto numbered = [&](int g, int i, const IntVec& q, int a, bool face) {
      const int k = q[a] + h.grid(g).layout.n * h.grid(g).mine(i).index.coord[a], all = h.grid(g).layout.n * h.grid(g).extent[a];
      return !turned ? k : face ? all - k : all - 1 - k;
    };
    // The coefficients: a cell's, and those of the edges of each plane (or of the faces across each axis), smooth and steep.
    constexpr int EDGES = DIM == 2 ? 1 : 3;
    amr::HierarchyField nu(h, std::vector<Component>(static_cast<std::size_t>(coupled ? 1 + EDGES : DIM)));
    for (int g = 0; g < h.grids(); ++g)
      for (int i = 0; i < h.grid(g).size(); ++i)
        for (int c = 0; c < nu.components(); ++c)
          for_all(h.grid(g).layout, [&](const IntVec& q) {
            double sum = 0;  // even about every side
            for (int a = 0; a < DIM; ++a) {
              const bool on_plane = !coupled ? a == c : c > 0 && (DIM == 2 || a != 3 - c);
              const double along = (numbered(g, i, q, a, on_plane) + (on_plane ? 0 : 0.5)) / (h.grid(g).layout.n * h.grid(g).extent[a]);
              sum += std::cos(3 * std::numbers::pi * along);
            }
            nu.at(g, i, c)[h.grid(g).layout.offset(q)] = std::exp(2 * sum);
          });
    amr::Multigrid solver(h, list, nu, {.lowest = coupled ? 12.0 : 6.0});
    std::vector<amr::Links> links(list.size());
    for (int a = 0; a < components; ++a) {
      links[static_cast<std::size_t>(a)].coupled = coupled;
      links[static_cast<std::size_t>(a)].sigma = 0.1;
      for (int b = 0; b < DIM; ++b) {
        amr::Links::Along& along = links[static_cast<std::size_t>(a)].along[b];
        along.field = !coupled ? b : a == b ? 0 : DIM == 2 ? 1 : a + b;
        along.below = coupled && a == b ? 1 : 0;
        along.factor = coupled && a == b ? 2 : 1;
      }
    }
    solver.prepare(links);
    for (int b = 0; b < mesh.size(); ++b) {
      const auto [g, i] = h.place_of_block(b);
      for (int c = 0; c < components; ++c) {
        const amr::Range r = h.unknowns(g, i, list[static_cast<std::size_t>(c)], true);
        amr::for_each_cell(r.lo, r.size, [&, g = g, i = i](const IntVec& q) {
          IntVec k{};
          for (int a = 0; a < DIM; ++a) k[a] = numbered(g, i, q, a, coupled && a == c);
          const double sign = turned && coupled ? -1 : 1;  // vectors turn with the box
          solver.rhs().at(g, i, c)[mesh.layout().offset(q)] = sign * noise(g, c, k[0], k[1], DIM == 3 ? k[DIM - 1] : 0);
        });
      }
    }
    solver.cycle();
    Result result;
    for (const amr::BlockIndex& leaf : tree.leaves()) {
      amr::BlockIndex here = leaf;
      for (int a = 0; a < DIM && turned; ++a) here.coord[a] = (shape.root_blocks[a] << leaf.level) - 1 - leaf.coord[a];
      const amr::Hierarchy::Place place = h.place_of_block(mesh.tree().find(here));
      result.leaves.push_back(leaf);
      std::vector<double>& values = result.values.emplace_back();
      for (int c = 0; c < components; ++c) {
        IntVec size = filled(n);
        if (coupled) ++size[c];
        amr::for_each_cell({}, size, [&](const IntVec& q) {
          IntVec p = q;
          for (int a = 0; a < DIM && turned; ++a) p[a] = n - q[a] - (coupled && a == c ? 0 : 1);
          const amr::Range r = h.unknowns(place.grid, place.node, list[static_cast<std::size_t>(c)], true);
          bool own = true;
          for (int a = 0; a < DIM; ++a) own = own && p[a] >= r.lo[a] && p[a] < r.lo[a] + r.size[a];
          const double value = solver.solution().at(place.grid, place.node, c)[mesh.layout().offset(p)];
          values.push_back(!own ? std::nan("") : turned && coupled ? -value : value);
        });
      }
    }
    return result;
  };
  const Result straight = cycle(false), turned = cycle(true);
  double largest = 0;
  for (const std::vector<double>& leaf : straight.values)
    for (const double v : leaf) largest = std::isnan(v) ? largest : std::max(largest, std::abs(v));
  Tally tally;
  for (std::size_t leaf = 0; leaf < straight.values.size(); ++leaf)
    for (std::size_t k = 0; k < straight.values[leaf].size(); ++k) {
      const double a = straight.values[leaf][k], b = turned.values[leaf][k];
      if (std::isnan(a) || std::isnan(b)) continue;  // a face of the node beyond
      tally.near(a, b, GetParam().tolerance * largest, [&] { return text(straight.leaves[leaf]) + ", value " + std::to_string(k); });
    }
  EXPECT_TRUE(tally.result());
  EXPECT_GT(tally.checks(), 400);
}

INSTANTIATE_TEST_SUITE_P(Trees, MultigridCycle,
                         ::testing::Values(Case{true, false, 1, 1e-12}, Case{true, false, 2, 1e-12}, Case{true, false, 3, 1e-12},
                                           Case{true, true, 1, 2e-3}, Case{true, true, 2, 2e-3}, Case{false, true, 1, 1e-12},
                                           Case{false, true, 2, 1e-12}),
                         name_of);

}  // namespace
}  // namespace dendrift::test

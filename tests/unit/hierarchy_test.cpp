// Faces and cells on all levels at once: what restriction, prolongation and ghost filling promise.
#include "amr/hierarchy.hpp"

#include <gtest/gtest.h>

#include <set>

#include "amr/face_transfer.hpp"
#include "support/mesh_fixture.hpp"

namespace dendrift::test {
namespace {

using amr::Component;
using amr::Grid;

// Coarse faces of a parent with ghosts, and room for a child. Faces beyond those that a parent fills are NaN.
struct ParentAndChild {
  static constexpr int N = 8;
  amr::Layout layout{N};
  std::vector<std::vector<double>> parent, child;
  Array<amr::ArrayRef<double>> fine{};
  Array<amr::ArrayRef<const double>> coarse{};

  template <class Value>
  explicit ParentAndChild(Value&& value) : parent(DIM), child(DIM) {
    for (int a = 0; a < DIM; ++a) {
      parent[a].resize(static_cast<std::size_t>(layout.size()));
      child[a].resize(static_cast<std::size_t>(layout.size()));
      double* p = parent[a].data() + layout.interior();
      for_all(layout, [&](const IntVec& c) {
        bool filled_by_parents = true;
        for (int b = 0; b < DIM; ++b) filled_by_parents = filled_by_parents && c[b] >= -1 && c[b] <= N / 2 + (b == a ? 1 : 0);
        p[layout.offset(c)] = filled_by_parents ? value(a, c) : std::numeric_limits<double>::quiet_NaN();
      });
      fine[a] = amr::array_ref(child[a].data() + layout.interior(), layout);
      coarse[a] = amr::array_ref(static_cast<const double*>(p), layout);
    }
  }
};

double outflow(const auto& faces, const IntVec& cell) {
  double sum = 0;
  for (int a = 0; a < DIM; ++a) {
    const double* v = faces[a].at(cell);
    sum += v[faces[a].stride[a]] - v[0];
  }
  return sum;
}

TEST(FaceTransfer, EveryFineCellGetsTheDivergenceOfItsParent) {
  ParentAndChild p([](int a, const IntVec& c) { return noise(a, c[0], c[1], DIM == 3 ? c[DIM - 1] : 0); });
  amr::prolong_faces(p.fine, p.coarse, ParentAndChild::N);
  Tally tally;
  amr::for_each_cell({}, filled(ParentAndChild::N), [&](const IntVec& q) {
    IntVec parent = q;
    for (int& c : parent) c >>= 1;
    // Per length: half the spacing, half the difference of the faces.
    tally.near(outflow(p.fine, q), 0.5 * outflow(p.coarse, parent), 1e-14, [&] { return "cell " + text(q); });
  });
  EXPECT_TRUE(tally.result());
}

TEST(FaceTransfer, FluxThroughCoarseFacesIsKept) {
  ParentAndChild p([](int a, const IntVec& c) { return noise(7 + a, c[0], c[1], DIM == 3 ? c[DIM - 1] : 0); });
  amr::prolong_faces(p.fine, p.coarse, ParentAndChild::N);
  for (int a = 0; a < DIM; ++a) {
    std::vector<double> back(static_cast<std::size_t>(p.layout.size()));
    const amr::ArrayRef<double> b = amr::array_ref(back.data() + p.layout.interior(), p.layout);
    amr::restrict_faces(b, {}, {p.fine[a].p, p.fine[a].stride}, filled(ParentAndChild::N / 2), a);
    Tally tally;
    IntVec size = filled(ParentAndChild::N / 2);
    ++size[a];
    amr::for_each_cell({}, size, [&](const IntVec& q) { tally.near(*b.at(q), *p.coarse[a].at(q), 1e-15, [&] { return text(q); }); });
    EXPECT_TRUE(tally.result()) << "axis " << a;
  }
}

TEST(FaceTransfer, RigidMotionIsExact) {
  // Turning about the origin and moving: linear, without strain, and so must the fine faces be.
  const auto velocity = [](int a, double x, double y) { return a == 0 ? 0.3 - 0.7 * y : a == 1 ? 0.1 + 0.7 * x : 0.2; };
  ParentAndChild p([&](int a, const IntVec& c) {
    return velocity(a, 2 * (c[0] + (a == 0 ? 0 : 0.5)), 2 * (c[1] + (a == 1 ? 0 : 0.5)));
  });
  amr::prolong_faces(p.fine, p.coarse, ParentAndChild::N);
  Tally tally;
  for (int a = 0; a < DIM; ++a)
    amr::for_each_cell({}, filled(ParentAndChild::N), [&](const IntVec& q) {
      tally.near(*p.fine[a].at(q), velocity(a, q[0] + (a == 0 ? 0 : 0.5), q[1] + (a == 1 ? 0 : 0.5)), 1e-13, [&] { return text(q); });
    });
  EXPECT_TRUE(tally.result());
}

std::vector<Component> stokes_like() {
  std::vector<Component> c(DIM + 1);
  for (int a = 0; a < DIM; ++a) c[static_cast<std::size_t>(a)].normal = a;
  return c;
}

// Place of a value in units of the finest spacing.
double place(const Grid& g, const Grid::Node& n, const IntVec& q, int axis, int normal) {
  return (n.index.coord[axis] * g.layout.n + q[axis] + (axis == normal ? 0.0 : 0.5)) * g.dx;
}

class MpiHierarchy : public ::testing::TestWithParam<Deal> {};

// Whatever the tree and its distribution: leaves see a linear field continued round them, to round-off, wherever no
// side of the domain is near.
TEST_P(MpiHierarchy, LinearFieldsContinueAcrossLevels) {
  Random random(11);
  const amr::MeshShape shape = shape_of(vec(2, 2, 1), axes(false, false, false), 3);
  amr::Mesh mesh(shape, {}, MPI_COMM_WORLD);
  for (int trial = 0; trial < 4; ++trial) {
    amr::Tree tree = random_tree(random, shape.root_blocks, shape.periodic(), 3, DIM == 2 ? 60 : 40);
    put(mesh, tree, deal_out(GetParam(), tree, mesh.ranks(), random));
    amr::Hierarchy h(mesh);
    amr::HierarchyField f(h, stokes_like());
    const auto value = [&](int g, int i, int c, const IntVec& q) {
      double v = 0.5 + c;
      for (int a = 0; a < DIM; ++a) v += (a + 1.0) * (c + 1) * place(h.grid(g), h.grid(g).mine(i), q, a, f.component(c).normal);
      return v;
    };
    for (int g = 0; g < h.levels(); ++g)
      for (int i = 0; i < h.grid(g).size(); ++i)
        for (int c = 0; c <= DIM; ++c)
          for_all(h.grid(g).layout, [&](const IntVec& q) {
            const bool known = h.grid(g).mine(i).leaf >= 0 && [&] {
              const amr::Range r = h.unknowns(g, i, f.component(c), true);
              for (int a = 0; a < DIM; ++a)
                if (q[a] < r.lo[a] || q[a] >= r.lo[a] + r.size[a]) return false;
              return true;
            }();
            f.at(g, i, c)[h.grid(g).layout.offset(q)] = known ? value(g, i, c, q) : 1e30;
          });
    h.make_composite(f, 2, true);
    Tally tally;
    for (int b = 0; b < mesh.size(); ++b) {
      const auto [g, i] = h.place_of_block(b);
      const Grid::Node& n = h.grid(g).mine(i);
      bool inside = true;  // and its parents' ghosts too
      for (int d = 0; d < DIRECTIONS; ++d) inside = inside && n.neighbours[static_cast<std::size_t>(d)] != Grid::OUTSIDE;
      if (!inside) continue;
      for (int c = 0; c <= DIM; ++c)
        for_all(h.grid(g).layout, [&](const IntVec& q) {
          const int a = f.component(c).normal;
          if (a >= 0 && q[a] > h.grid(g).layout.n) return;
          double near_side = 1e30;  // interpolation from a parent beside a side of the domain may use its mirror image
          for (int e = 0; e < DIM; ++e) {
            const double x = place(h.grid(g), n, q, e, a), end = (mesh.shape().hi()[e] - mesh.shape().lo[e]);
            near_side = std::min({near_side, x, end - x});
          }
          if (near_side < 6 * h.grid(g).dx) return;
          const double want = value(g, i, c, q);
          tally.near(f.at(g, i, c)[h.grid(g).layout.offset(q)], want, 1e-12 * std::abs(want),
                     [&] { return "component " + std::to_string(c) + " of " + text(n.index) + " at " + text(q); });
        });
    }
    EXPECT_TRUE(tally.result()) << "trial " << trial;
    EXPECT_GT(over_ranks(tally.checks(), MPI_COMM_WORLD), 0) << "nothing was compared";
  }
}

// Rough values: what a ghost holds must be what the node holds that its place belongs to, corners of refined regions and
// planes of faces between finer and coarser leaves included.
TEST_P(MpiHierarchy, GhostsAreTheValuesOfTheirPlaces) {
  Random random(12);
  const amr::MeshShape shape = shape_of(vec(2, 2, 1), axes(false, false, false), 3);
  amr::Mesh mesh(shape, {}, MPI_COMM_WORLD);
  for (int trial = 0; trial < 4; ++trial) {
    amr::Tree tree = random_tree(random, shape.root_blocks, shape.periodic(), 3, DIM == 2 ? 60 : 200);
    put(mesh, tree, deal_out(GetParam(), tree, mesh.ranks(), random));
    amr::Hierarchy h(mesh);
    amr::HierarchyField f(h, stokes_like());
    const int n = mesh.layout().n;
    const auto at_place = [&](int g, int c, const IntVec& q) { return noise(g, c, q[0], q[1], DIM == 3 ? q[DIM - 1] : 0); };
    const auto global = [&](int g, int i, IntVec q) {
      for (int a = 0; a < DIM; ++a) q[a] += n * h.grid(g).mine(i).index.coord[a];
      return q;
    };
    for (int g = 0; g < h.levels(); ++g)
      for (int i = 0; i < h.grid(g).size(); ++i)
        for (int c = 0; c <= DIM; ++c) {
          for_all(mesh.layout(), [&](const IntVec& q) { f.at(g, i, c)[mesh.layout().offset(q)] = 1e30; });
          const amr::Range r = h.unknowns(g, i, f.component(c), false);
          amr::for_each_cell(r.lo, r.size, [&](const IntVec& q) { f.at(g, i, c)[mesh.layout().offset(q)] = at_place(g, c, global(g, i, q)); });
        }
    Tally tally;
    for (int g = h.levels() - 1; g >= 0; --g) {
      h.fill_from_coarser(f, f, g);
      h.exchange(f, g, amr::Layout::GHOSTS);
      std::set<IntVec> nodes;
      for (const Grid::Node& m : h.grid(g).nodes) nodes.insert(m.index.coord);
      for (int i = 0; i < h.grid(g).size(); ++i)
        for (int c = 0; c <= DIM; ++c)
          for_all(mesh.layout(), [&](const IntVec& q) {
            const int normal = f.component(c).normal;
            IntVec node = global(g, i, q);
            for (int a = 0; a < DIM; ++a) {
              if (node[a] < 0 || node[a] > h.grid(g).extent[a] * n || (a != normal && node[a] == h.grid(g).extent[a] * n)) return;
              node[a] /= n;
            }
            bool known = nodes.contains(node);
            if (!known && normal >= 0 && global(g, i, q)[normal] % n == 0) {  // the last plane of the node below
              --node[normal];
              known = nodes.contains(node);
            }
            if (!known) return;
            tally.near(f.at(g, i, c)[mesh.layout().offset(q)], at_place(g, c, global(g, i, q)), 0, [&] {
              return "component " + std::to_string(c) + " of " + text(h.grid(g).mine(i).index) + " at " + text(q);
            });
          });
    }
    EXPECT_TRUE(tally.result()) << "trial " << trial;
    EXPECT_GT(over_ranks(tally.checks(), MPI_COMM_WORLD), 0) << "nothing was compared";
  }
}

// A box, its sides and its values turned end for end along all axes: so is all that leaves see round them, whichever sides
// are free. Planes of faces on high sides are nobody's low planes and want care of their own.
TEST_P(MpiHierarchy, MirrorImagesAgree) {
  Random random(13);
  const amr::MeshShape shape = shape_of(vec(2, 1, 1), axes(false, false, false), 3);
  const int n = shape.block_cells;
  amr::Mesh mesh(shape, {}, MPI_COMM_WORLD), turned_mesh(shape, {}, MPI_COMM_SELF);
  for (int trial = 0; trial < 4; ++trial) {
    const amr::Tree tree = random_tree(random, shape.root_blocks, shape.periodic(), 3, DIM == 2 ? 60 : 200);
    std::vector<amr::BlockIndex> leaves(tree.leaves().begin(), tree.leaves().end());
    for (amr::BlockIndex& b : leaves)
      for (int a = 0; a < DIM; ++a) b.coord[a] = (shape.root_blocks[a] << b.level) - 1 - b.coord[a];
    put(mesh, tree, deal_out(GetParam(), tree, mesh.ranks(), random));
    put(turned_mesh, amr::Tree(shape.root_blocks, shape.periodic(), 3, leaves), std::vector<int>(leaves.size(), 0));
    std::vector<Component> components = stokes_like(), turned = components;
    for (std::size_t c = 0; c < components.size(); ++c)
      for (std::size_t f = 0; f < FACES; ++f) turned[c].sides[f ^ 1].odd = components[c].sides[f].odd = random.chance(0.5);
    const auto filled_in = [&](amr::Hierarchy& h, const std::vector<Component>& list, bool is_turned) {
      amr::HierarchyField f(h, list);
      for (int g = 0; g < h.levels(); ++g)
        for (int i = 0; i < h.grid(g).size(); ++i)
          for (int c = 0; c <= DIM; ++c) {
            for_all(mesh.layout(), [&](const IntVec& q) { f.at(g, i, c)[mesh.layout().offset(q)] = 1e30; });
            if (h.grid(g).mine(i).leaf < 0) continue;
            const amr::Range r = h.unknowns(g, i, f.component(c), true);
            amr::for_each_cell(r.lo, r.size, [&](const IntVec& q) {
              IntVec place{};
              for (int a = 0; a < DIM; ++a) {
                place[a] = q[a] + n * h.grid(g).mine(i).index.coord[a];
                if (is_turned) place[a] = h.grid(g).extent[a] * n - place[a] - (a == f.component(c).normal ? 0 : 1);
              }
              f.at(g, i, c)[mesh.layout().offset(q)] = noise(g, c, place[0], place[1], DIM == 3 ? place[DIM - 1] : 0);
            });
          }
      h.make_composite(f, 1, true);
      return f;
    };
    amr::Hierarchy h(mesh), other(turned_mesh);
    const amr::HierarchyField f = filled_in(h, components, false), image = filled_in(other, turned, true);
    Tally tally;
    for (int b = 0; b < mesh.size(); ++b) {
      const auto [g, i] = h.place_of_block(b);
      amr::BlockIndex opposite = h.grid(g).mine(i).index;
      for (int a = 0; a < DIM; ++a) opposite.coord[a] = h.grid(g).extent[a] - 1 - opposite.coord[a];
      const amr::Hierarchy::Place there = other.place_of_block(turned_mesh.tree().find(opposite));
      for (int c = 0; c <= DIM; ++c) {
        const int normal = f.component(c).normal;
        IntVec size = filled(n + 2);
        if (normal >= 0) ++size[normal];
        amr::for_each_cell(filled(-1), size, [&, g = g, i = i](const IntVec& q) {
          IntVec p{};
          for (int a = 0; a < DIM; ++a) p[a] = n - q[a] - (a == normal ? 0 : 1);
          const double got = f.at(g, i, c)[mesh.layout().offset(q)];
          tally.near(got, image.at(there.grid, there.node, c)[mesh.layout().offset(p)], 1e-13, [&] {
            return "component " + std::to_string(c) + " of " + text(h.grid(g).mine(i).index) + " at " + text(q);
          });
          tally.expect(std::abs(got) < 100, [&] { return "nothing was written to " + text(q) + " of component " + std::to_string(c); });
        });
      }
    }
    EXPECT_TRUE(tally.result()) << "trial " << trial;
    EXPECT_GT(over_ranks(tally.checks(), MPI_COMM_WORLD), 0) << "nothing was compared";
  }
}

INSTANTIATE_TEST_SUITE_P(Deals, MpiHierarchy, ::testing::ValuesIn(kDeals));

}  // namespace
}  // namespace dendrift::test

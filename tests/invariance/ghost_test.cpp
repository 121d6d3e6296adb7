// Ghost cells: right for polynomials, right cell by cell against an independent answer, and the same bits
// however the blocks are spread over ranks.
#include "amr/ghost.hpp"

#include <gtest/gtest.h>
#include <mpi.h>

#include <atomic>
#include <cmath>
#include <numbers>
#include <vector>

#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Deal;
using test::Oracle;
using test::Quadratic;
using test::Random;
using test::Tally;

namespace {

constexpr int kMaxLeaves = DIM == 2 ? 120 : 70;

FieldSpec spec_of(const std::string& name) {
  FieldSpec spec;
  spec.name = name;
  spec.transfer = Transfer::conservative;
  return spec;
}

struct Domain {
  IntVec roots;
  Array<bool> periodic;
};

std::vector<Domain> domains() {
  using test::axes, test::vec;
  return {{vec(1, 1, 1), axes(true, true, true)},
          {vec(2, 1, 1), axes(false, false, false)},
          {vec(1, 3, 2), axes(true, false, true)},
          {vec(3, 2, 1), axes(false, true, false)},
          {vec(2, 2, 2), axes(true, true, false)}};
}

std::string place(const Mesh& mesh, int b, const IntVec& cell) {
  return "block " + test::text(mesh.block(b).index) + " cell " + test::text(cell) + " on rank " +
         std::to_string(mesh.rank());
}

/// Every value of `field`, ghosts included, has the bits that it has in `whole`.
void compare_bits(const Mesh& mesh, const Mesh& whole, CellField field, Tally& tally) {
  for (int b = 0; b < mesh.size(); ++b) {
    const double* p = mesh.cells(field, b);
    const double* q = whole.cells(field, whole.local(mesh.block(b).leaf));
    test::for_all(mesh.layout(), [&](const IntVec& c) {
      const std::ptrdiff_t o = mesh.layout().offset(c);
      tally.bits(p[o], q[o], [&] { return place(mesh, b, c); });
    });
  }
}

}  // namespace

TEST(MpiGhostExchange, EveryGhostOfRandomData) {
  // Fields without smoothness leave no room for errors that happen to cancel. "value" is one number for all
  // sides of a field, so that the order in which sides are served cannot show in the corners.
  FieldTable table;
  const CellField even = table.add_cell(spec_of("even"));
  FieldSpec mixed = spec_of("mixed");
  for (const int face : {0, 3}) mixed.sides[static_cast<std::size_t>(face)] = {SideRule::Kind::value, -0.5};
  const std::vector<CellField> fields{even, table.add_cell(mixed)};

  Random random(1);
  std::array<std::int64_t, 4> seen{};  // ghosts over coarser, equal, finer leaves and beyond sides
  for (const Domain& domain : domains()) {
    for (int trial = 0; trial < (DIM == 2 ? 3 : 1); ++trial) {
      const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
      Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
      test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
      Mesh whole = test::whole_copy(mesh);
      for (const CellField f : fields) {
        test::set_noise(mesh, f, f.id);
        test::set_noise(whole, f, f.id);
      }
      GhostExchange ghosts(mesh);
      ghosts.fill(fields);

      Tally tally;
      for (const CellField f : fields) {
        const Oracle oracle(whole, f);
        for (int b = 0; b < mesh.size(); ++b) {
          const int level = mesh.block(b).index.level, n = mesh.layout().n;
          const double* p = mesh.cells(f, b);
          test::for_all(mesh.layout(), [&](const IntVec& c) {
            const double got = p[mesh.layout().offset(c)];
            const auto where = [&] { return mesh.fields().row(f.id).name + ", " + place(mesh, b, c); };
            if (test::is_interior(c, n)) {
              const double* q = whole.cells(f, whole.local(mesh.block(b).leaf));
              tally.bits(got, q[mesh.layout().offset(c)], where);
              return;
            }
            const IntVec g = test::global_cell(mesh.block(b), c, n);
            const int relation = oracle.relation(level, g);
            ++seen[static_cast<std::size_t>(relation + 1)];
            if (relation == 0) {
              tally.bits(got, oracle.value(level, g), where);
            } else {
              tally.near(got, oracle.value(level, g), 2e-14, where);
            }
          });
        }
      }
      EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " trial " << trial;
    }
  }
  for (const std::int64_t n : seen)
    EXPECT_GT(test::over_ranks(n, MPI_COMM_WORLD), 0) << "nothing of a kind was checked";
}

TEST(MpiGhostExchange, QuadraticsAreExact) {
  // No use of the library's own formula here. Along each axis the polynomial is what the sides allow:
  // constant where periodic, even about one wall, or anything at all; ghosts that then need the wrong side
  // are left out.
  enum class Axis { constant, even_low, even_high, free };
  FieldTable table;
  const CellField f = table.add_cell(spec_of("f"));
  Random random(2);
  std::int64_t prolonged = 0;
  for (const Domain& domain : domains()) {
    for (int trial = 0; trial < 4; ++trial) {
      const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
      Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3, trial == 3 ? 16 : 8), table, MPI_COMM_WORLD);
      test::put(
          mesh, tree,
          test::deal_out(test::kDeals[static_cast<std::size_t>(trial % 3)], tree, mesh.ranks(), random));
      const RealVec lo = mesh.shape().lo, hi = mesh.shape().hi();
      Quadratic q;
      Array<Axis> axis{};
      q.constant = random.symmetric();
      for (int a = 0; a < DIM; ++a) {
        axis[a] = trial == 0 ? Axis::free : static_cast<Axis>(1 + random.below(3));
        if (domain.periodic[a]) axis[a] = Axis::constant;
        q.origin[a] = axis[a] == Axis::even_low ? lo[a] : hi[a];
      }
      for (int a = 0; a < DIM; ++a) {
        if (axis[a] == Axis::free) q.linear[a] = random.symmetric();
        if (axis[a] != Axis::constant) q.second[a][a] = 1 + random.unit();
        for (int b = a + 1; b < DIM; ++b)
          if (axis[a] == Axis::free && axis[b] == Axis::free) q.second[a][b] = random.symmetric();
      }
      test::set_interior(mesh, f, [&](const Block& block, const IntVec& c) {
        return q.mean(test::cell_centre(block, c), block.dx);
      });
      GhostExchange ghosts(mesh);
      ghosts.fill({f});

      Tally tally;
      for (int b = 0; b < mesh.size(); ++b) {
        const Block& block = mesh.block(b);
        const double* p = mesh.cells(f, b);
        test::for_all(mesh.layout(), [&](const IntVec& c) {
          if (test::is_interior(c, mesh.layout().n)) return;
          const IntVec g = test::global_cell(block, c, mesh.layout().n);
          for (int a = 0; a < DIM;
               ++a) {  // coarse cells around the parent of the cell, in the coarse numbering
            const int first = (g[a] >> 1) - 1, last = (g[a] >> 1) + 1;
            const int extent = (domain.roots[a] << block.index.level) * mesh.layout().n / 2;
            if (first < 0 && (axis[a] == Axis::even_high || axis[a] == Axis::free)) return;
            if (last >= extent && (axis[a] == Axis::even_low || axis[a] == Axis::free)) return;
          }
          const double want = q.mean(test::cell_centre(block, c), block.dx);
          tally.near(p[mesh.layout().offset(c)], want, 1e-11, [&] { return place(mesh, b, c); });
        });
      }
      for (int i = 0; i < tree.size(); ++i)
        for (int dir = 0; dir < DIRECTIONS; ++dir)
          if (tree.neighbour(i, dir).kind == Neighbour::Kind::coarser) ++prolonged;
      EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " trial " << trial;
      EXPECT_GT(test::over_ranks(tally.checks(), MPI_COMM_WORLD), 0);
    }
  }
  EXPECT_GT(prolonged, 100);
}

TEST(MpiGhostExchange, SidesMirrorOrFixTheGhosts) {
  FieldTable table;
  const CellField even = table.add_cell(spec_of("even"));
  FieldSpec spec = spec_of("fixed");
  const double wall = 2.5;
  for (SideRule& side : spec.sides) side = {SideRule::Kind::value, wall};
  const CellField fixed = table.add_cell(spec);
  Random random(3);
  const IntVec roots = test::vec(2, 1, 1);
  const Tree tree = test::random_tree(random, roots, {}, 3, kMaxLeaves);
  Mesh mesh(test::shape_of(roots, {}, 3), table, MPI_COMM_WORLD);
  test::put(mesh, tree, test::deal_out(Deal::curve, tree, mesh.ranks(), random));
  test::set_noise(mesh, even, 1);
  GhostExchange ghosts(mesh);
  test::set_noise(mesh, fixed, 2);
  ghosts.fill({even, fixed});
  Tally tally;
  for (int b = 0; b < mesh.size(); ++b) {
    const Layout& layout = mesh.layout();
    test::for_all(layout, [&](const IntVec& c) {
      for (int a = 0; a < DIM; ++a) {
        const int g = test::global_cell(mesh.block(b), c, layout.n)[a];
        const int extent = (roots[a] << mesh.block(b).index.level) * layout.n;
        if (g >= 0 && g < extent) continue;
        IntVec mirror = c;
        mirror[a] = g < 0 ? -1 - c[a] : 2 * layout.n - 1 - c[a];
        const auto where = [&] { return place(mesh, b, c); };
        const double* e = mesh.cells(even, b);
        const double* v = mesh.cells(fixed, b);
        tally.bits(e[layout.offset(c)], e[layout.offset(mirror)], where);
        tally.bits(v[layout.offset(c)], wall, where);
      }
    });
  }
  EXPECT_TRUE(tally.result());
  EXPECT_GT(test::over_ranks(tally.checks(), MPI_COMM_WORLD), 0);

  // A field that equals the wall's value everywhere stays so, in every ghost.
  test::set_interior(mesh, fixed, [&](const Block&, const IntVec&) { return wall; });
  ghosts.fill({fixed});
  Tally constant;
  for (int b = 0; b < mesh.size(); ++b) {
    test::for_all(mesh.layout(), [&](const IntVec& c) {
      constant.bits(mesh.cells(fixed, b)[mesh.layout().offset(c)], wall, [&] { return place(mesh, b, c); });
    });
  }
  EXPECT_TRUE(constant.result());
}

TEST(MpiGhostExchange, SameBitsForAnyDistribution) {
  FieldTable table;
  const CellField f = table.add_cell(spec_of("f"));
  FieldSpec fixed = spec_of("g");
  for (SideRule& side : fixed.sides) side = {SideRule::Kind::value, 0.1};
  const CellField g = table.add_cell(fixed);
  Random random(4);
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    GhostExchange ghosts(mesh);
    for (const Deal deal : test::kDeals) {
      test::put(mesh, tree, test::deal_out(deal, tree, mesh.ranks(), random));
      Mesh whole = test::whole_copy(mesh);
      GhostExchange whole_ghosts(whole);
      for (const CellField field : {f, g}) {
        test::set_noise(mesh, field, 5 + field.id);
        test::set_noise(whole, field, 5 + field.id);
      }
      ghosts.fill({f, g});
      whole_ghosts.fill({f, g});
      Tally tally;
      compare_bits(mesh, whole, f, tally);
      compare_bits(mesh, whole, g, tally);
      EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " deal " << static_cast<int>(deal);
    }
  }
}

TEST(MpiGhostExchange, SeveralFieldsAsOneByOne) {
  FieldTable table;
  std::vector<CellField> together, alone;
  for (int i = 0; i < 4; ++i) together.push_back(table.add_cell(spec_of("together" + std::to_string(i))));
  for (int i = 0; i < 4; ++i) alone.push_back(table.add_cell(spec_of("alone" + std::to_string(i))));
  const CellField bystander = table.add_cell(spec_of("bystander"));
  Random random(5);
  const IntVec roots = test::vec(2, 2, 1);
  const Array<bool> periodic = test::axes(false, true, true);
  const Tree tree = test::random_tree(random, roots, periodic, 2, kMaxLeaves);
  Mesh mesh(test::shape_of(roots, periodic, 2), table, MPI_COMM_WORLD);
  test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
  for (std::size_t i = 0; i < 4; ++i) {
    test::set_noise(mesh, together[i], static_cast<int>(i));
    test::set_noise(mesh, alone[i], static_cast<int>(i));
  }
  test::set_noise(mesh, bystander, 9);
  GhostExchange ghosts(mesh);
  ghosts.fill({together[2], together[0], together[3], together[1]});
  for (const CellField f : alone) ghosts.fill({f});
  ghosts.fill({});
  Tally tally;
  for (int b = 0; b < mesh.size(); ++b) {
    test::for_all(mesh.layout(), [&](const IntVec& c) {
      const std::ptrdiff_t o = mesh.layout().offset(c);
      const auto where = [&] { return place(mesh, b, c); };
      for (std::size_t i = 0; i < 4; ++i)
        tally.bits(mesh.cells(together[i], b)[o], mesh.cells(alone[i], b)[o], where);
      if (!test::is_interior(c, mesh.layout().n))
        tally.expect(std::isnan(mesh.cells(bystander, b)[o]), where);
    });
  }
  EXPECT_TRUE(tally.result());
  EXPECT_GE(ghosts.wait_seconds(), 0);
  EXPECT_GE(ghosts.fill_seconds(), 0);
}

TEST(MpiGhostExchange, KernelSeesFilledGhostsOfItsBlock) {
  FieldTable table;
  const CellField f = table.add_cell(spec_of("f")), g = table.add_cell(spec_of("g"));
  const CellField seen = table.add_cell(spec_of("seen"));
  Random random(6);
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
    test::set_noise(mesh, f, 1);
    test::set_noise(mesh, g, 2);
    std::vector<std::atomic<int>> calls(static_cast<std::size_t>(mesh.size()));
    GhostExchange ghosts(mesh);
    ghosts.fill_and_run({f, g}, [&](int b) {
      ++calls[static_cast<std::size_t>(b)];
      const double* p = mesh.cells(f, b);
      const double* q = mesh.cells(g, b);
      double* out = mesh.cells(seen, b);
      test::for_all(mesh.layout(), [&](const IntVec& c) {
        const std::ptrdiff_t o = mesh.layout().offset(c);
        out[o] = p[o] + 3 * q[o];
        // The kernel may use the ghosts of its block as scratch: nobody else reads them.
        if (!test::is_interior(c, mesh.layout().n)) mesh.cells(f, b)[o] = mesh.cells(g, b)[o] = 1e30;
      });
    });
    for (const std::atomic<int>& n : calls) EXPECT_EQ(n, 1);
    ghosts.fill({f, g});
    Tally tally;
    for (int b = 0; b < mesh.size(); ++b) {
      test::for_all(mesh.layout(), [&](const IntVec& c) {
        const std::ptrdiff_t o = mesh.layout().offset(c);
        tally.near(mesh.cells(seen, b)[o], mesh.cells(f, b)[o] + 3 * mesh.cells(g, b)[o], 1e-14,
                   [&] { return place(mesh, b, c); });
      });
    }
    EXPECT_TRUE(tally.result()) << test::text(domain.roots);
  }
}

TEST(MpiGhostExchange, FollowsChangesOfMeshAndSwaps) {
  FieldTable table;
  const CellField f = table.add_cell(spec_of("f")), g = table.add_cell(spec_of("g"));
  Random random(7);
  const IntVec roots = test::vec(2, 1, 1);
  const Array<bool> periodic = test::axes(true, false, true);
  Mesh mesh(test::shape_of(roots, periodic, 3), table, MPI_COMM_WORLD);
  GhostExchange ghosts(mesh);  // one for all meshes to come
  for (int change = 0; change < 5; ++change) {
    if (change > 0) {
      const Tree tree = test::random_tree(random, roots, periodic, 3, kMaxLeaves / 2);
      test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
    }
    Mesh whole = test::whole_copy(mesh);
    GhostExchange fresh(whole);
    test::set_noise(mesh, f, 10 + change);
    test::set_noise(mesh, g, 20 + change);
    test::set_noise(whole, f, 20 + change);  // as it will be after the swap
    test::set_noise(whole, g, 10 + change);
    mesh.swap(f, g);
    ghosts.fill({f});
    ghosts.fill({g});
    fresh.fill({f, g});
    Tally tally;
    compare_bits(mesh, whole, f, tally);
    compare_bits(mesh, whole, g, tally);
    EXPECT_TRUE(tally.result()) << "mesh " << change;
  }
}

TEST(MpiGhostExchange, ProlongedGhostsConvergeWithThirdOrder) {
  // One level of refinement in a corner of a periodic box; the error in all ghosts over coarser leaves.
  FieldTable table;
  const CellField f = table.add_cell(spec_of("f"));
  std::vector<double> errors;
  for (const int n : {8, 16, 32}) {
    MeshShape shape = test::shape_of(filled(2), test::axes(true, true, true), 1, n);
    shape.root_dx = 0.5 / n;  // a box of side one
    Mesh mesh(shape, table, MPI_COMM_WORLD);
    std::vector<std::int8_t> change(static_cast<std::size_t>(mesh.tree().size()), 0);
    change[0] = 1;
    const Tree tree = mesh.tree().adapted(change);
    Random random(8);
    test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
    const auto mean = [&](const Block& block, const IntVec& c) {
      const double k = 2 * std::numbers::pi, half = k * block.dx / 2;
      double phase = 0.4;
      for (int a = 0; a < DIM; ++a) phase += k * (a == 1 ? -1 : 1) * test::cell_centre(block, c)[a];
      return std::cos(phase) * std::pow(std::sin(half) / half, DIM);
    };
    test::set_interior(mesh, f, mean);
    GhostExchange ghosts(mesh);
    ghosts.fill({f});
    double worst = 0;
    for (int b = 0; b < mesh.size(); ++b) {
      if (mesh.block(b).index.level == 0) continue;
      test::for_all(mesh.layout(), [&](const IntVec& c) {
        worst = std::max(worst, std::abs(mesh.cells(f, b)[mesh.layout().offset(c)] - mean(mesh.block(b), c)));
      });
    }
    MPI_Allreduce(MPI_IN_PLACE, &worst, 1, MPI_DOUBLE, MPI_MAX, MPI_COMM_WORLD);
    errors.push_back(worst);
  }
  for (std::size_t i = 1; i < errors.size(); ++i) {
    const double order = std::log2(errors[i - 1] / errors[i]);
    EXPECT_GT(order, 2.8) << errors[i - 1] << " " << errors[i];
    EXPECT_LT(order, 3.3);
  }
}

// Changing the mesh: what is refined, coarsened and moved keeps its integral, its polynomials and its bits.
#include "amr/regrid.hpp"

#include <gtest/gtest.h>
#include <mpi.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <set>
#include <vector>

#include "amr/comm.hpp"
#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Deal;
using test::Oracle;
using test::Quadratic;
using test::Random;
using test::Tally;

namespace {

constexpr int kMaxLeaves = DIM == 2 ? 120 : 60;
constexpr double kEps = std::numeric_limits<double>::epsilon();

struct Domain {
  IntVec roots;
  Array<bool> periodic;
};

std::vector<Domain> domains() {
  using test::axes, test::vec;
  return {{vec(1, 1, 1), axes(true, true, true)},
          {vec(2, 1, 1), axes(false, false, false)},
          {vec(1, 3, 2), axes(true, false, true)}};
}

/// Two fields that are kept, one that is not, one on faces.
struct Fields {
  FieldTable table;
  CellField u, w, scratch;
  FaceField flux;

  Fields() {
    FieldSpec kept;
    kept.transfer = Transfer::conservative;
    kept.name = "u";
    u = table.add_cell(kept);
    FieldSpec none;
    none.name = "scratch";
    scratch = table.add_cell(none);
    kept.name = "w";
    for (SideRule& side : kept.sides) side = {SideRule::Kind::value, 0.5};
    w = table.add_cell(kept);
    none.name = "flux";
    flux = table.add_face(none);
  }
};

/// A wish of every local block that depends on where it is and not on who owns it. `grow`, `shrink`:
/// probabilities.
std::vector<Tag> random_tags(const Mesh& mesh, int seed, double grow, double shrink) {
  std::vector<Tag> tags;
  for (const Block& block : mesh.blocks()) {
    const BlockIndex& i = block.index;
    const int z = i.coord[DIM - 1];
    const double dice = 0.5 + 0.5 * test::noise(seed, 1, i.level, i.coord[0], i.coord[1], z);
    Tag tag;
    tag.level = i.level + (dice < grow ? 1 : (dice < grow + shrink ? -1 : 0));
    tag.level = std::clamp(tag.level, 0, mesh.shape().max_level);
    tag.keep = tag.level;
    tag.weight = 1.5 + test::noise(seed, 2, i.level, i.coord[0], i.coord[1], z);
    tags.push_back(tag);
  }
  return tags;
}

/// Random tags that keep the tree about as large as `leaves`.
std::vector<Tag> steady_tags(const Mesh& mesh, int seed, int leaves) {
  const double room =
      static_cast<double>(leaves - mesh.tree().size()) / (2.0 * CHILDREN * mesh.tree().size());
  return random_tags(mesh, seed, std::clamp(room, 0.01, 0.3), seed % 3 == 0 ? 0.8 : 0.3);
}

std::vector<Tag> neutral_tags(const Mesh& mesh) {
  std::vector<Tag> tags;
  for (const Block& block : mesh.blocks())
    tags.push_back({.level = block.index.level, .keep = block.index.level});
  return tags;
}

std::vector<double> integrals(const Mesh& mesh, CellField field) {
  std::vector<ExactSum> sums(2);
  for (int b = 0; b < mesh.size(); ++b) {
    const double cell = std::pow(mesh.block(b).dx, DIM);  // a power of two: no rounding
    test::for_interior(mesh.layout(), [&](const IntVec& c) {
      const double x = mesh.cells(field, b)[mesh.layout().offset(c)] * cell;
      sums[0].add(x);
      sums[1].add(std::abs(x));
    });
  }
  return exact_sums(sums, mesh.comm());
}

std::vector<BlockIndex> leaves_of(const Tree& tree) { return {tree.leaves().begin(), tree.leaves().end()}; }
std::vector<int> owners_of(const Mesh& mesh) { return {mesh.owners().begin(), mesh.owners().end()}; }

/// The same numbers on all ranks?
template <class T>
bool agreed(const std::vector<T>& mine, MPI_Comm comm) {
  const std::vector<T> all = all_gather<T>(mine, comm);
  if (all.size() != mine.size() * static_cast<std::size_t>(test::ranks_of(comm))) return false;
  for (std::size_t i = 0; i < all.size(); ++i)
    if (!(all[i] == mine[i % mine.size()])) return false;
  return true;
}

/// Blocks, leaves and owners fit together.
testing::AssertionResult consistent(const Mesh& mesh) {
  const Tree& tree = mesh.tree();
  if (static_cast<int>(mesh.owners().size()) != tree.size()) return testing::AssertionFailure() << "owners";
  int mine = 0;
  std::set<int> slots;
  for (int leaf = 0; leaf < tree.size(); ++leaf) {
    const int b = mesh.local(leaf);
    if ((b >= 0) != (mesh.owner(leaf) == mesh.rank())) return testing::AssertionFailure() << "leaf " << leaf;
    if (b < 0) continue;
    ++mine;
    const Block& block = mesh.block(b);
    if (block.leaf != leaf || block.index != tree.leaf(leaf) || !slots.insert(block.slot).second) {
      return testing::AssertionFailure() << "block of leaf " << leaf;
    }
  }
  if (mine != mesh.size())
    return testing::AssertionFailure() << mine << " leaves in " << mesh.size() << " blocks";
  if (!agreed(leaves_of(tree), mesh.comm()) || !agreed(owners_of(mesh), mesh.comm()) ||
      !agreed(std::vector<std::int64_t>{mesh.generation()}, mesh.comm())) {
    return testing::AssertionFailure() << "ranks disagree";
  }
  return testing::AssertionSuccess();
}

}  // namespace

TEST(MpiMesh, StartsWithTheRootBlocks) {
  const Fields f;
  for (const Domain& domain : domains()) {
    const MeshShape shape = test::shape_of(domain.roots, domain.periodic, 2);
    const Mesh mesh(shape, f.table, MPI_COMM_WORLD);
    EXPECT_EQ(leaves_of(mesh.tree()), leaves_of(Tree(domain.roots, domain.periodic, 2)));
    EXPECT_TRUE(consistent(mesh));
    EXPECT_EQ(mesh.ranks(), test::ranks_of(MPI_COMM_WORLD));
    for (const Block& block : mesh.blocks()) {
      EXPECT_EQ(block.dx, shape.root_dx);
      for (int a = 0; a < DIM; ++a) {
        EXPECT_EQ(block.lo[a], shape.lo[a] + block.index.coord[a] * 8 * shape.root_dx);
        EXPECT_EQ(shape.hi()[a], shape.lo[a] + domain.roots[a] * 8 * shape.root_dx);
      }
    }
    const Block fine = mesh.describe({2, filled(3)});
    EXPECT_EQ(fine.dx, shape.root_dx / 4);
    EXPECT_EQ(fine.lo[0], shape.lo[0] + 3 * 8 * shape.root_dx / 4);
    EXPECT_GE(mesh.bytes(), static_cast<std::int64_t>(sizeof(double)) * mesh.size() * f.table.size() *
                                mesh.layout().size());
  }
}

TEST(MpiMesh, ArraysDoNotOverlapAndSwapInPlace) {
  const Fields f;
  const IntVec roots = test::vec(2, 2, 1);
  Mesh mesh(test::shape_of(roots, {}, 1), f.table, MPI_COMM_WORLD);
  const auto value = [](int field, int b, std::ptrdiff_t o) { return test::noise(field, b, o); };
  const auto each = [&](auto&& visit) {
    for (int b = 0; b < mesh.size(); ++b) {
      for (int id = 0; id < f.table.size(); ++id) {
        test::for_all(mesh.layout(), [&](const IntVec& c) {
          const std::ptrdiff_t o = mesh.layout().offset(c);
          visit(mesh.array(id, mesh.block(b).slot)[o], id, b, o);
        });
      }
    }
  };
  each([&](double& x, int id, int b, std::ptrdiff_t o) { x = value(id, b, o); });
  Tally tally;
  each([&](double& x, int id, int b, std::ptrdiff_t o) {
    tally.bits(x, value(id, b, o), [] { return std::string("arrays overlap"); });
  });
  for (int b = 0; b < mesh.size(); ++b) {
    EXPECT_EQ(mesh.cells(f.u, b), mesh.array(f.u.id, mesh.block(b).slot));
    for (int a = 0; a < DIM; ++a)
      EXPECT_EQ(mesh.faces(f.flux, a, b), mesh.array(f.flux.id + a, mesh.block(b).slot));
  }
  mesh.swap(f.u, f.scratch);
  each([&](double& x, int id, int b, std::ptrdiff_t o) {
    const int was = id == f.u.id ? f.scratch.id : (id == f.scratch.id ? f.u.id : id);
    tally.bits(x, value(was, b, o), [] { return std::string("after the swap"); });
  });
  EXPECT_TRUE(tally.result());
}

TEST(MpiRegrid, ProposalFollowsTheTags) {
  const Fields f;
  Random random(1);
  int refined = 0, coarsened = 0;
  for (const Domain& domain : domains()) {
    for (int trial = 0; trial < 6; ++trial) {
      const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
      Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), f.table, MPI_COMM_WORLD);
      test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
      Mesh whole = test::whole_copy(mesh);  // knows all tags
      std::vector<Tag> all = random_tags(whole, trial, 0.2, 0.7), mine = random_tags(mesh, trial, 0.2, 0.7);
      const Proposal p = propose(mesh, mine);

      std::vector<std::int8_t> change;
      for (int i = 0; i < tree.size(); ++i) {
        const Tag& tag = all[static_cast<std::size_t>(whole.local(i))];
        const int level = tree.leaf(i).level;
        change.push_back(static_cast<std::int8_t>(tag.level > level ? 1 : (tag.level < level ? -1 : 0)));
      }
      EXPECT_EQ(leaves_of(p.tree), leaves_of(tree.adapted(change)));
      EXPECT_EQ(p.changed, leaves_of(p.tree) != leaves_of(tree));
      ASSERT_EQ(p.weights.size(), static_cast<std::size_t>(p.tree.size()));
      for (int i = 0; i < tree.size(); ++i) {
        const int stays = p.tree.find(tree.leaf(i));
        if (stays >= 0) {
          EXPECT_EQ(p.weights[static_cast<std::size_t>(stays)],
                    all[static_cast<std::size_t>(whole.local(i))].weight);
        }
        if (p.tree.leaf(p.tree.locate(tree.leaf(i))).level < tree.leaf(i).level) ++coarsened;
        if (p.tree.leaf(p.tree.locate(tree.leaf(i))).level > tree.leaf(i).level) ++refined;
      }
      for (const double weight : p.weights) EXPECT_GT(weight, 0);
      const Proposal alone = propose(whole, all);
      EXPECT_EQ(leaves_of(p.tree), leaves_of(alone.tree)) << "the proposal depends on the ranks";
      EXPECT_EQ(p.weights, alone.weights);
      EXPECT_TRUE(agreed(leaves_of(p.tree), MPI_COMM_WORLD));

      const Proposal none = propose(mesh, neutral_tags(mesh));
      EXPECT_FALSE(none.changed);
      EXPECT_EQ(leaves_of(none.tree), leaves_of(tree));
    }
  }
  EXPECT_GT(refined, 0);
  EXPECT_GT(coarsened, 0);
}

TEST(MpiRegrid, KeepIsHysteresis) {
  const Fields f;
  const IntVec roots = test::vec(2, 1, 1);
  Mesh mesh(test::shape_of(roots, {}, 2), f.table, MPI_COMM_WORLD);
  const Tree fine = Tree(roots, {}, 2).adapted(std::vector<std::int8_t>(2, 1));
  Random random(2);
  test::put(mesh, fine, test::deal_out(Deal::curve, fine, mesh.ranks(), random));
  for (const int keep : {0, 1, 2}) {
    std::vector<Tag> tags;
    for (const Block& block : mesh.blocks()) {  // the family of the first root holds on to its level
      Tag tag;
      tag.keep = block.index.coord[0] < 2 ? keep : 0;
      tags.push_back(tag);
    }
    const Proposal p = propose(mesh, tags);
    EXPECT_TRUE(p.changed);
    EXPECT_EQ(p.tree.size(), keep == 0 ? 2 : CHILDREN + 1) << "keep " << keep;
    EXPECT_GE(p.tree.find({0, test::vec(1, 0, 0)}), 0) << "nothing keeps the other family";
  }
}

TEST(MpiRegrid, ReachRefinesTheNeighbours) {
  const Fields f;
  Random random(3);
  std::int64_t reached = 0;
  for (const Domain& domain : domains()) {
    for (int trial = 0; trial < 6; ++trial) {
      const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
      Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), f.table, MPI_COMM_WORLD);
      test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
      Mesh whole = test::whole_copy(mesh);
      const auto tags_of = [&](const Mesh& m) {  // all would shrink, were it not for a few that reach out
        std::vector<Tag> tags;
        for (const Block& block : m.blocks()) {
          Tag tag;
          if (0.5 + 0.5 * test::noise(trial, 3, block.leaf) < 0.2) {
            tag.reach = static_cast<std::uint32_t>(0.5 * (1 + test::noise(trial, 4, block.leaf)) *
                                                   (1U << DIRECTIONS));
            tag.reach_level = block.index.level + (test::noise(trial, 5, block.leaf) > 0 ? 1 : 0);
            tag.level = tag.keep = block.index.level;
          }
          tags.push_back(tag);
        }
        return tags;
      };
      const std::vector<Tag> all = tags_of(whole);
      const Proposal p = propose(mesh, tags_of(mesh));
      std::vector<FinerNeighbour> finer;
      for (int i = 0; i < tree.size(); ++i) {
        const Tag& tag = all[static_cast<std::size_t>(whole.local(i))];
        for (int dir = 0; dir < DIRECTIONS; ++dir) {
          if (dir == CENTRE || (tag.reach >> dir & 1U) == 0) continue;
          const Neighbour n = tree.neighbour(i, dir);
          if (n.leaf >= 0) {
            const int level = tree.leaf(n.leaf).level;
            const int wanted =
                std::min({tag.reach_level, level + 1, tree.max_level()});  // one level at a time
            const int got = p.tree.leaf(p.tree.locate(tree.leaf(n.leaf))).level;
            EXPECT_GE(got, wanted) << test::text(tree.leaf(i)) << " reaches "
                                   << test::text(tree.leaf(n.leaf));
            if (wanted > level) ++reached;
          }
        }
      }
      EXPECT_EQ(leaves_of(p.tree), leaves_of(propose(whole, all).tree));
    }
  }
  EXPECT_GT(reached, 10);
}

TEST(MpiRegrid, EveryCellOfRandomData) {
  // Old data without smoothness; each cell of the new mesh against what it must be: a copy, a mean, a
  // prolongation.
  const Fields f;
  Random random(4);
  std::array<std::int64_t, 3> seen{};
  for (const Domain& domain : domains()) {
    for (const Partitioner partitioner : {Partitioner::curve, Partitioner::graph}) {
      for (int trial = 0; trial < (DIM == 2 ? 3 : 1); ++trial) {
        const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
        Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), f.table, MPI_COMM_WORLD);
        test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
        Mesh old = test::whole_copy(mesh);
        for (const CellField field : {f.u, f.w, f.scratch}) {
          test::set_noise(mesh, field, field.id);
          test::set_noise(old, field, field.id);
        }
        for (int b = 0; b < mesh.size(); ++b) mesh.faces(f.flux, 0, b)[0] = 1 + mesh.block(b).leaf;
        std::map<BlockIndex, const double*> was;
        for (int b = 0; b < mesh.size(); ++b) was[mesh.block(b).index] = mesh.cells(f.u, b);
        const std::int64_t generation = mesh.generation();

        GhostExchange ghosts(mesh);
        int seed = 40 + trial;
        Proposal p = propose(mesh, random_tags(mesh, seed, 0.1, 0.85));
        while (!p.changed) p = propose(mesh, random_tags(mesh, ++seed, 0.1, 0.85));
        EXPECT_TRUE(regrid(mesh, ghosts, p, {.partitioner = partitioner}));
        EXPECT_EQ(leaves_of(mesh.tree()), leaves_of(p.tree));
        EXPECT_TRUE(consistent(mesh));
        EXPECT_NE(mesh.generation(), generation);

        Tally tally;
        for (int b = 0; b < mesh.size(); ++b) {
          const Block& block = mesh.block(b);
          const auto where = [&](const IntVec& c) {
            return test::text(block.index) + " cell " + test::text(c);
          };
          const int before = tree.find(block.index);
          for (const CellField field : {f.u, f.w}) {
            const Oracle oracle(old, field);
            test::for_interior(mesh.layout(), [&](const IntVec& c) {
              const double got = mesh.cells(field, b)[mesh.layout().offset(c)];
              if (before >= 0) {
                tally.bits(got, old.cells(field, old.local(before))[old.layout().offset(c)],
                           [&] { return where(c); });
              } else {
                if (DIM == 3 && (c[0] + c[1] + c[2 % DIM]) % 3 != 0)
                  return;  // all places in a parent, for less time
                const IntVec g = test::global_cell(block, c, mesh.layout().n);
                tally.near(got, oracle.value(block.index.level, g), 2e-14, [&] { return where(c); });
              }
            });
          }
          const auto stayed = was.find(block.index);
          if (stayed != was.end()) {
            EXPECT_EQ(mesh.cells(f.u, b), stayed->second) << "a block that stays keeps its arrays";
            EXPECT_EQ(mesh.faces(f.flux, 0, b)[0], 1 + before);
            test::for_interior(mesh.layout(), [&](const IntVec& c) {
              const std::ptrdiff_t o = mesh.layout().offset(c);
              tally.bits(mesh.cells(f.scratch, b)[o], old.cells(f.scratch, old.local(before))[o],
                         [&] { return where(c); });
            });
            ++seen[0];
          } else if (before < 0) {
            test::for_all(mesh.layout(), [&](const IntVec& c) {
              const std::ptrdiff_t o = mesh.layout().offset(c);
              tally.bits(mesh.cells(f.scratch, b)[o], 0,
                         [&] { return "scratch in a new block, " + where(c); });
              for (int a = 0; a < DIM; ++a) {
                tally.bits(mesh.faces(f.flux, a, b)[o], 0,
                           [&] { return "faces of a new block, " + where(c); });
              }
            });
            const int covered = tree.leaf(tree.locate(block.index)).level;
            ++seen[covered > block.index.level ? 1 : 2];
          }
        }
        EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " trial " << trial;
      }
    }
  }
  for (const std::int64_t n : seen)
    EXPECT_GT(test::over_ranks(n, MPI_COMM_WORLD), 0) << "stayed, coarsened, refined";
}

TEST(MpiRegrid, KeepsQuadraticsInRefinement) {
  // A polynomial that all sides allow: even about the low wall of each axis, constant along periodic ones.
  // New cells whose parents see the high wall are left out.
  const Fields f;
  Random random(5);
  for (const Domain& domain : domains()) {
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), f.table, MPI_COMM_WORLD);
    Quadratic q;
    q.constant = 1;
    q.origin = mesh.shape().lo;
    for (int a = 0; a < DIM; ++a)
      if (!domain.periodic[a]) q.second[a][a] = 0.5 + a;
    const auto mean = [&](const Block& block, const IntVec& c) {
      return q.mean(test::cell_centre(block, c), block.dx);
    };
    test::set_interior(mesh, f.u, mean);
    test::set_interior(mesh, f.w, mean);
    GhostExchange ghosts(mesh);
    for (int round = 0; round < 5; ++round) {
      const Proposal p = propose(mesh, random_tags(mesh, 50 + round, round == 0 ? 0.7 : 0.15, 0));
      regrid(mesh, ghosts, p, {.partitioner = round % 2 == 0 ? Partitioner::curve : Partitioner::graph});
      Tally tally;
      for (int b = 0; b < mesh.size(); ++b) {
        const Block& block = mesh.block(b);
        test::for_interior(mesh.layout(), [&](const IntVec& c) {
          bool at_wall = false;
          for (int a = 0; a < DIM;
               ++a) {  // the parent's neighbours may be prolonged in turn, from their own parents'
            const int extent = (domain.roots[a] << block.index.level) * mesh.layout().n;
            const int seen = test::global_cell(block, c, mesh.layout().n)[a] / 4 + 2;
            at_wall = at_wall || (!domain.periodic[a] && 4 * seen >= extent);
          }
          double& value = mesh.cells(f.u, b)[mesh.layout().offset(c)];
          if (!at_wall)
            tally.near(value, mean(block, c), 1e-11, [&] { return test::text(block.index) + test::text(c); });
          value = mean(block, c);  // what the high wall spoiled must not spread in later rounds
        });
      }
      EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " round " << round;
    }
    EXPECT_GT(mesh.tree().finest_level(), 1);
  }
}

TEST(MpiRegrid, ConservesThroughHundredsOfAdaptations) {
  const Fields f;
  for (const Partitioner partitioner : {Partitioner::curve, Partitioner::graph}) {
    const IntVec roots = test::vec(2, 1, 1);
    Mesh mesh(test::shape_of(roots, test::axes(false, true, false), 3), f.table, MPI_COMM_WORLD);
    GhostExchange ghosts(mesh);
    test::set_noise(mesh, f.u, 1);
    test::set_interior(mesh, f.w, [](const Block& block, const IntVec& c) {
      return 1e3 + std::sin(test::cell_centre(block, c)[0] + 2 * test::cell_centre(block, c)[1]);
    });
    const auto u0 = integrals(mesh, f.u), w0 = integrals(mesh, f.w);
    int changes = 0;
    std::int64_t most_bytes = 0;
    int most_leaves = 0, finest = 0;
    const int rounds = (DIM == 2 ? 200 : 100) / (mesh.ranks() > 1 ? 2 : 1);
    for (int round = 0; round < rounds; ++round) {
      const Proposal p = propose(mesh, steady_tags(mesh, round, DIM == 2 ? 80 : 50));
      changes += regrid(mesh, ghosts, p, {.partitioner = partitioner}) ? 1 : 0;
      most_leaves = std::max(most_leaves, mesh.tree().size());
      finest = std::max(finest, mesh.tree().finest_level());
      most_bytes = std::max(most_bytes, mesh.bytes());
      if (round % 5 != 4) continue;
      const auto u = integrals(mesh, f.u), w = integrals(mesh, f.w);
      // Each adaptation adds a rounding error a cell, of either sign.
      EXPECT_LE(std::abs(u[0] - u0[0]), 2 * kEps * std::sqrt(round + 1) * u[1]) << "round " << round;
      EXPECT_LE(std::abs(w[0] - w0[0]), 2 * kEps * std::sqrt(round + 1) * w[1]) << "round " << round;
    }
    EXPECT_TRUE(consistent(mesh));
    EXPECT_GT(changes, rounds / 2);
    EXPECT_EQ(finest, 3);
    // Slots are used again: never more than the old and the new set of blocks together.
    const std::int64_t slot =
        static_cast<std::int64_t>(sizeof(double)) * (mesh.layout().size() + 8) * f.table.size();
    EXPECT_LE(most_bytes, 2 * slot * most_leaves);
  }
}

TEST(MpiRegrid, SameBitsForAnyNumberOfRanks) {
  const Fields f;
  for (const Partitioner partitioner : {Partitioner::curve, Partitioner::graph}) {
    const IntVec roots = test::vec(1, 2, 1);
    const MeshShape shape = test::shape_of(roots, test::axes(true, false, true), 3);
    Mesh mesh(shape, f.table, MPI_COMM_WORLD), whole(shape, f.table, MPI_COMM_SELF);
    GhostExchange ghosts(mesh), whole_ghosts(whole);
    test::set_noise(mesh, f.u, 1);
    test::set_noise(whole, f.u, 1);
    test::set_noise(mesh, f.w, 2);
    test::set_noise(whole, f.w, 2);
    const RegridOptions options{.partitioner = partitioner, .max_imbalance = 1.2};
    for (int round = 0; round < 25; ++round) {
      regrid(mesh, ghosts, propose(mesh, steady_tags(mesh, 100 + round, kMaxLeaves)), options);
      regrid(whole, whole_ghosts, propose(whole, steady_tags(whole, 100 + round, kMaxLeaves)), options);
      ASSERT_EQ(leaves_of(mesh.tree()), leaves_of(whole.tree())) << "round " << round;
      Tally tally;
      for (int b = 0; b < mesh.size(); ++b) {
        for (const CellField field : {f.u, f.w}) {
          test::for_interior(mesh.layout(), [&](const IntVec& c) {
            const std::ptrdiff_t o = mesh.layout().offset(c);
            tally.bits(mesh.cells(field, b)[o], whole.cells(field, whole.local(mesh.block(b).leaf))[o],
                       [&] { return test::text(mesh.block(b).index) + " cell " + test::text(c); });
          });
        }
      }
      EXPECT_TRUE(tally.result()) << "round " << round;
    }
  }
}

TEST(MpiRegrid, NoChangeLeavesTheMeshAlone) {
  const Fields f;
  Random random(6);
  for (const Partitioner partitioner : {Partitioner::curve, Partitioner::graph}) {
    const IntVec roots = test::vec(2, 2, 1);
    Mesh mesh(test::shape_of(roots, {}, 2), f.table, MPI_COMM_WORLD);
    const Tree tree = test::random_tree(random, roots, {}, 2, kMaxLeaves);
    test::put(mesh, tree,
              test::deal_out(partitioner == Partitioner::curve ? Deal::curve : Deal::graph, tree,
                             mesh.ranks(), random));
    test::set_noise(mesh, f.u, 1);
    std::vector<const double*> arrays;
    for (int b = 0; b < mesh.size(); ++b) arrays.push_back(mesh.cells(f.u, b));
    const std::vector<int> owners = owners_of(mesh);
    const std::int64_t generation = mesh.generation();
    GhostExchange ghosts(mesh);
    const Proposal p = propose(mesh, neutral_tags(mesh));
    EXPECT_FALSE(p.changed);
    EXPECT_FALSE(regrid(mesh, ghosts, p, {.partitioner = partitioner}));
    EXPECT_EQ(mesh.generation(), generation);
    EXPECT_EQ(owners_of(mesh), owners);
    ASSERT_EQ(mesh.size(), static_cast<int>(arrays.size()));
    for (int b = 0; b < mesh.size(); ++b) EXPECT_EQ(mesh.cells(f.u, b), arrays[static_cast<std::size_t>(b)]);
  }
}

TEST(MpiRegrid, BlocksMoveOnlyWhenTheLoadDemandsIt) {
  const Fields f;
  const IntVec roots = DIM == 2 ? filled(8) : filled(4);
  const int ranks = test::ranks_of(MPI_COMM_WORLD);
  for (const Partitioner partitioner : {Partitioner::curve, Partitioner::graph}) {
    Mesh mesh(test::shape_of(roots, {}, 1), f.table, MPI_COMM_WORLD);
    test::set_noise(mesh, f.u, 1);
    GhostExchange ghosts(mesh);
    std::vector<Tag> tags;
    for (const Block& block : mesh.blocks()) {  // the first quarter of the curve is expensive
      Tag tag;
      tag.weight = block.leaf < mesh.tree().size() / 4 ? 10 : 1;
      tags.push_back(tag);
    }
    const Proposal p = propose(mesh, tags);
    const std::vector<int> owners = owners_of(mesh);
    const std::int64_t generation = mesh.generation();
    const double before = imbalance(p.weights, owners, ranks);
    EXPECT_FALSE(regrid(mesh, ghosts, p, {.partitioner = partitioner, .max_imbalance = 1.01 * before}));
    EXPECT_EQ(owners_of(mesh), owners);
    EXPECT_EQ(mesh.generation(), generation);
    const bool moved = regrid(mesh, ghosts, p, {.partitioner = partitioner, .max_imbalance = 1.1});
    EXPECT_EQ(moved, ranks > 1);
    EXPECT_EQ(mesh.generation() != generation, moved);
    EXPECT_TRUE(consistent(mesh));
    const double mean = std::accumulate(p.weights.begin(), p.weights.end(), 0.0) / ranks;
    EXPECT_LE(imbalance(p.weights, mesh.owners(), ranks), 1 + 10 / mean);
    Mesh whole = test::whole_copy(mesh);
    test::set_noise(whole, f.u, 1);
    Tally tally;
    for (int b = 0; b < mesh.size(); ++b) {
      test::for_interior(mesh.layout(), [&](const IntVec& c) {
        const std::ptrdiff_t o = mesh.layout().offset(c);
        tally.bits(mesh.cells(f.u, b)[o], whole.cells(f.u, whole.local(mesh.block(b).leaf))[o],
                   [&] { return test::text(mesh.block(b).index) + test::text(c); });
      });
    }
    EXPECT_TRUE(tally.result());
  }
}

TEST(MpiRegrid, PatientOwnersKeepTheirBlocksWhenTheTreeChanges) {
  const Fields f;
  Random random(7);
  const Tree tree = test::random_tree(random, filled(2), {}, 3, kMaxLeaves);
  Mesh mesh(test::shape_of(filled(2), {}, 3), f.table, MPI_COMM_WORLD);
  test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
  test::set_noise(mesh, f.u, 1);
  test::set_noise(mesh, f.w, 1);
  GhostExchange ghosts(mesh);
  const std::vector<int> owners = owners_of(mesh);
  const Proposal p = propose(mesh, random_tags(mesh, 1, 0.1, 0.8));
  EXPECT_TRUE(p.changed);
  EXPECT_TRUE(regrid(mesh, ghosts, p, {.partitioner = Partitioner::curve, .max_imbalance = 1e9}));
  for (int leaf = 0; leaf < mesh.tree().size(); ++leaf) {
    const int before = tree.find(mesh.tree().leaf(leaf));
    if (before >= 0) {
      EXPECT_EQ(mesh.owner(leaf), owners[static_cast<std::size_t>(before)]) << leaf;
    }
  }
  EXPECT_TRUE(consistent(mesh));
}

TEST(MpiRegrid, MigrationRoundTripKeepsBits) {
  const Fields f;
  Random random(8);
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), f.table, MPI_COMM_WORLD);
    const std::vector<int> home = test::deal_out(Deal::curve, tree, mesh.ranks(), random);
    test::put(mesh, tree, home);
    Mesh whole = test::whole_copy(mesh);
    for (const CellField field : {f.u, f.w}) {
      test::set_noise(mesh, field, field.id);
      test::set_noise(whole, field, field.id);
    }
    for (int hop = 0; hop < 8; ++hop) {
      std::vector<int> owners =
          test::deal_out(test::kDeals[static_cast<std::size_t>(hop % 3)], tree, mesh.ranks(), random);
      if (hop == 4) std::fill(owners.begin(), owners.end(), mesh.ranks() - 1);  // most ranks own nothing
      if (hop == 7) owners = home;
      std::map<int, const double*> was;
      for (int b = 0; b < mesh.size(); ++b) was[mesh.block(b).leaf] = mesh.cells(f.u, b);
      migrate(mesh, owners);
      ASSERT_EQ(owners_of(mesh), owners);
      EXPECT_TRUE(consistent(mesh));
      EXPECT_EQ(leaves_of(mesh.tree()), leaves_of(tree));
      Tally tally;
      for (int b = 0; b < mesh.size(); ++b) {
        const int leaf = mesh.block(b).leaf;
        if (was.contains(leaf)) {
          EXPECT_EQ(mesh.cells(f.u, b), was[leaf]) << "a block that stays keeps its slot";
        }
        for (const CellField field : {f.u, f.w}) {
          test::for_interior(mesh.layout(), [&](const IntVec& c) {
            const std::ptrdiff_t o = mesh.layout().offset(c);
            tally.bits(mesh.cells(field, b)[o], whole.cells(field, whole.local(leaf))[o],
                       [&] { return test::text(mesh.block(b).index) + " cell " + test::text(c); });
          });
        }
      }
      EXPECT_TRUE(tally.result()) << "hop " << hop;
      EXPECT_EQ(test::over_ranks(mesh.size(), MPI_COMM_WORLD), tree.size());
    }
  }
}

// The forest of leaves against answers worked out node by node from nothing but the set of leaves.
#include "amr/tree.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <numeric>
#include <optional>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Random;

namespace {

BlockIndex parent_of(BlockIndex node) {
  --node.level;
  for (int& c : node.coord) c >>= 1;
  return node;
}

BlockIndex child_of(const BlockIndex& node, int child) {
  BlockIndex r{node.level + 1, {}};
  for (int a = 0; a < DIM; ++a) r.coord[a] = 2 * node.coord[a] + (child >> a & 1);
  return r;
}

/// A forest as a plain set of nodes.
struct Model {
  IntVec roots{};
  Array<bool> periodic{};
  int max_level = 0;
  std::set<BlockIndex> leaves;

  explicit Model(const Tree& tree)
      : roots(tree.root_blocks()),
        periodic(tree.periodic()),
        max_level(tree.max_level()),
        leaves(tree.leaves().begin(), tree.leaves().end()) {}

  /// The node one step away, or nothing beyond a wall.
  std::optional<BlockIndex> step(BlockIndex node, const IntVec& offset) const {
    for (int a = 0; a < DIM; ++a) {
      const int extent = roots[a] << node.level;
      node.coord[a] += offset[a];
      if (node.coord[a] >= 0 && node.coord[a] < extent) continue;
      if (!periodic[a]) return std::nullopt;
      node.coord[a] = (node.coord[a] + extent) % extent;
    }
    return node;
  }
  /// The leaf that is the node or lies above it.
  std::optional<BlockIndex> cover(BlockIndex node) const {
    for (;; node = parent_of(node)) {
      if (leaves.contains(node)) return node;
      if (node.level == 0) return std::nullopt;
    }
  }
  /// Leaves that touch `node` from `from`'s point of view, any difference of levels. A leaf may find itself.
  std::vector<BlockIndex> touching(const BlockIndex& node) const {
    std::set<BlockIndex> found;
    for (int dir = 0; dir < DIRECTIONS; ++dir) {
      if (dir == CENTRE) continue;
      const std::optional<BlockIndex> next = step(node, direction_offset(dir));
      if (!next) continue;
      if (const std::optional<BlockIndex> above = cover(*next)) {
        found.insert(*above);
      } else {
        descend(*next, direction_offset(dir), found);
      }
    }
    return {found.begin(), found.end()};
  }
  void descend(const BlockIndex& node, const IntVec& offset, std::set<BlockIndex>& found) const {
    for (int child = 0; child < CHILDREN; ++child) {
      bool touches = true;
      for (int a = 0; a < DIM; ++a) {
        if (offset[a] != 0 && (child >> a & 1) != (offset[a] > 0 ? 0 : 1)) touches = false;
      }
      if (!touches) continue;
      const BlockIndex below = child_of(node, child);
      if (leaves.contains(below)) {
        found.insert(below);
      } else if (below.level < max_level) {
        descend(below, offset, found);
      }
    }
  }
  bool balanced() const {
    for (const BlockIndex& leaf : leaves)
      for (const BlockIndex& other : touching(leaf))
        if (std::abs(other.level - leaf.level) > 1) return false;
    return true;
  }
  /// No leaf lies in another, all lie in the domain, and their volumes add up to its volume.
  bool tiles() const {
    std::int64_t found = 0;
    for (const BlockIndex& leaf : leaves) {
      if (leaf.level < 0 || leaf.level > max_level) return false;
      for (int a = 0; a < DIM; ++a)
        if (leaf.coord[a] < 0 || leaf.coord[a] >= roots[a] << leaf.level) return false;
      if (leaf.level > 0 && cover(parent_of(leaf))) return false;
      found += std::int64_t{1} << (DIM * (max_level - leaf.level));
    }
    return found == volume(roots) << (DIM * max_level);
  }
};

/// Place along the Morton curve: the bits of the low corner in units of the finest level, x lowest.
std::vector<int> morton(const BlockIndex& node, int max_level) {
  std::vector<int> bits;
  for (int bit = 30; bit >= 0; --bit) {
    for (int a = DIM - 1; a >= 0; --a) {
      const std::int64_t corner = std::int64_t{node.coord[a]} << (max_level - node.level);
      bits.push_back(static_cast<int>(corner >> bit & 1));
    }
  }
  return bits;
}

testing::AssertionResult valid(const Tree& tree) {
  const Model model(tree);
  if (static_cast<int>(model.leaves.size()) != tree.size())
    return testing::AssertionFailure() << "a leaf twice";
  if (!model.tiles()) return testing::AssertionFailure() << "gap or overlap";
  if (!model.balanced()) return testing::AssertionFailure() << "not balanced";
  for (int i = 0; i + 1 < tree.size(); ++i) {
    if (morton(tree.leaf(i), tree.max_level()) >= morton(tree.leaf(i + 1), tree.max_level())) {
      return testing::AssertionFailure() << "leaves " << i << " and " << i + 1 << " are not in Morton order";
    }
  }
  return testing::AssertionSuccess();
}

/// The least change of the mesh that grants every refinement and keeps balance, by trial until nothing moves.
std::set<BlockIndex> adapted_by_trial(const Tree& tree, const std::vector<std::int8_t>& change) {
  const Model model(tree);
  std::map<BlockIndex, std::vector<BlockIndex>> touching;
  for (const BlockIndex& leaf : tree.leaves()) touching[leaf] = model.touching(leaf);
  std::map<BlockIndex, int> wanted, target;
  for (int i = 0; i < tree.size(); ++i) wanted[tree.leaf(i)] = change[static_cast<std::size_t>(i)];
  for (const auto& [leaf, ask] : wanted) {
    int level = leaf.level + (ask > 0 && leaf.level < tree.max_level() ? 1 : 0);
    if (ask < 0 && leaf.level > 0) {
      bool all = true;
      for (int child = 0; child < CHILDREN; ++child) {
        const auto sibling = wanted.find(child_of(parent_of(leaf), child));
        all = all && sibling != wanted.end() && sibling->second < 0;
      }
      if (all) level = leaf.level - 1;
    }
    target[leaf] = level;
  }
  for (bool moved = true; moved;) {
    moved = false;
    for (auto& [leaf, level] : target) {
      for (const BlockIndex& other : touching[leaf]) {
        if (target[other] <= level + 1) continue;
        moved = true;
        if (level < leaf.level) {  // a family stays whole
          for (int child = 0; child < CHILDREN; ++child)
            target[child_of(parent_of(leaf), child)] = leaf.level;
        } else {
          level = leaf.level + 1;
        }
      }
    }
  }
  std::set<BlockIndex> leaves;
  for (const auto& [leaf, level] : target) {
    if (level == leaf.level) leaves.insert(leaf);
    if (level < leaf.level) leaves.insert(parent_of(leaf));
    if (level > leaf.level)
      for (int child = 0; child < CHILDREN; ++child) leaves.insert(child_of(leaf, child));
  }
  return leaves;
}

struct Forest {
  IntVec roots;
  Array<bool> periodic;
  int max_level;
};

std::vector<Forest> forests() {
  using test::axes, test::vec;
  return {{vec(1, 1, 1), axes(false, false, false), 4}, {vec(1, 1, 1), axes(true, true, true), 4},
          {vec(3, 2, 1), axes(false, true, false), 3},  {vec(1, 3, 2), axes(true, false, true), 3},
          {vec(5, 1, 2), axes(false, false, true), 3},  {vec(2, 2, 2), axes(true, true, true), 3},
          {vec(4, 7, 1), axes(true, false, false), 2}};
}

constexpr int kMaxLeaves = DIM == 2 ? 200 : 220;

std::vector<BlockIndex> leaves_of(const Tree& tree) { return {tree.leaves().begin(), tree.leaves().end()}; }

Tree with_leaves(const Tree& like, std::vector<BlockIndex> leaves) {
  return {like.root_blocks(), like.periodic(), like.max_level(), std::move(leaves)};
}

std::vector<std::int8_t> no_change(const Tree& tree) {
  return std::vector<std::int8_t>(static_cast<std::size_t>(tree.size()), 0);
}

Tree refined(const Tree& tree, const std::vector<BlockIndex>& nodes) {
  std::vector<std::int8_t> change = no_change(tree);
  for (const BlockIndex& node : nodes) change[static_cast<std::size_t>(tree.find(node))] = 1;
  return tree.adapted(change);
}

}  // namespace

TEST(Tree, StartsAsRootBlocksAlongTheMortonCurve) {
  for (const Forest& f : forests()) {
    const Tree tree(f.roots, f.periodic, f.max_level);
    EXPECT_EQ(tree.size(), volume(f.roots));
    EXPECT_EQ(tree.root_blocks(), f.roots);
    EXPECT_EQ(tree.periodic(), f.periodic);
    EXPECT_EQ(tree.max_level(), f.max_level);
    EXPECT_EQ(tree.finest_level(), 0);
    EXPECT_TRUE(valid(tree));
  }
}

TEST(Tree, MortonOrderOfKnownForest) {
  // 3 x 2 roots: the curve visits the low square first, then what is left of the high one.
  const Tree tree(test::vec(3, 2, 1), {}, 1);
  std::vector<BlockIndex> expected;
  for (const IntVec& c : {test::vec(0, 0, 0), test::vec(1, 0, 0), test::vec(0, 1, 0), test::vec(1, 1, 0),
                          test::vec(2, 0, 0), test::vec(2, 1, 0)}) {
    expected.push_back({0, c});
  }
  EXPECT_EQ(leaves_of(tree), expected);

  const Tree finer = refined(tree, {{0, test::vec(1, 0, 0)}});
  std::vector<BlockIndex> with_children{{0, test::vec(0, 0, 0)}};
  for (int child = 0; child < CHILDREN; ++child)
    with_children.push_back(child_of({0, test::vec(1, 0, 0)}, child));
  with_children.insert(with_children.end(), expected.begin() + 2, expected.end());
  EXPECT_EQ(leaves_of(finer), with_children);
  EXPECT_EQ(finer.finest_level(), 1);
}

TEST(Tree, LocatesEveryNode) {
  Random random(11);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    const Model model(tree);
    test::Tally tally;
    for (int i = 0; i < tree.size(); ++i) {
      const BlockIndex leaf = tree.leaf(i);
      tally.expect(tree.find(leaf) == i && tree.locate(leaf) == i,
                   [&] { return "itself, " + test::text(leaf); });
      if (leaf.level < tree.max_level()) {
        for (int child = 0; child < CHILDREN; ++child) {
          tally.expect(tree.find(child_of(leaf, child)) == -1 && tree.locate(child_of(leaf, child)) == i,
                       [&] { return "child of " + test::text(leaf); });
        }
      }
    }
    for (int trial = 0; trial < 2000; ++trial) {
      BlockIndex node{random.below(f.max_level + 1), {}};
      for (int a = 0; a < DIM; ++a) node.coord[a] = random.below(f.roots[a] << node.level);
      int expected = -1;
      if (const std::optional<BlockIndex> above = model.cover(node)) {
        expected = static_cast<int>(std::find(tree.leaves().begin(), tree.leaves().end(), *above) -
                                    tree.leaves().begin());
      } else {  // the first leaf below it in the order of the leaves
        for (int i = tree.size() - 1; i >= 0; --i) {
          BlockIndex up = tree.leaf(i);
          while (up.level > node.level) up = parent_of(up);
          if (up == node) expected = i;
        }
      }
      tally.expect(tree.locate(node) == expected, [&] { return "locate " + test::text(node); });
      tally.expect(tree.find(node) == (model.leaves.contains(node) ? expected : -1),
                   [&] { return "find " + test::text(node); });
    }
    EXPECT_TRUE(tally.result());
  }
}

TEST(Tree, NeighboursInAllDirections) {
  Random random(12);
  std::map<Neighbour::Kind, int> seen;
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    const Model model(tree);
    test::Tally tally;
    for (int i = 0; i < tree.size(); ++i) {
      const BlockIndex leaf = tree.leaf(i);
      for (int dir = 0; dir < DIRECTIONS; ++dir) {
        const auto where = [&] {
          return test::text(leaf) + " direction " + test::text(direction_offset(dir));
        };
        const Neighbour n = tree.neighbour(i, dir);
        std::vector<FinerNeighbour> finer{{-7, {}}};  // must still be there afterwards
        if (n.kind == Neighbour::Kind::finer) tree.finer_neighbours(i, dir, finer);
        tally.expect(!finer.empty() && finer[0].leaf == -7, where);
        std::set<std::pair<int, IntVec>> found, expected;
        for (std::size_t k = 1; k < finer.size(); ++k) found.insert({finer[k].leaf, finer[k].child});
        tally.expect(found.size() + 1 == finer.size(), where);

        const std::optional<BlockIndex> next = model.step(leaf, direction_offset(dir));
        if (!next) {
          tally.expect(n.kind == Neighbour::Kind::boundary && n.leaf == -1, where);
        } else if (const std::optional<BlockIndex> cover = model.cover(*next)) {
          tally.expect(
              n.kind == (cover->level == leaf.level ? Neighbour::Kind::same : Neighbour::Kind::coarser),
              where);
          tally.expect(n.leaf >= 0 && tree.leaf(n.leaf) == *cover, where);
        } else {
          tally.expect(n.kind == Neighbour::Kind::finer && n.leaf == -1, where);
          for (int child = 0; child < CHILDREN; ++child) {
            IntVec place{};
            bool touches = true;
            for (int a = 0; a < DIM; ++a) {
              place[a] = child >> a & 1;
              const int o = direction_offset(dir)[a];
              if (o != 0 && place[a] != (o > 0 ? 0 : 1)) touches = false;
            }
            if (touches) expected.insert({tree.find(child_of(*next, child)), place});
          }
        }
        tally.expect(found == expected, where);
        if (dir != CENTRE) ++seen[n.kind];
      }
    }
    EXPECT_TRUE(tally.result());
  }
  EXPECT_EQ(seen.size(), 4U) << "the forests should show every kind of neighbour";
}

TEST(Tree, TouchingLeaves) {
  Random random(13);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    const Model model(tree);
    test::Tally tally;
    for (int i = 0; i < tree.size(); ++i) {
      std::vector<int> expected, found = tree.touching(i);
      for (const BlockIndex& other : model.touching(tree.leaf(i))) expected.push_back(tree.find(other));
      std::sort(expected.begin(), expected.end());
      // Whether a leaf that meets itself around a periodic axis counts is left open.
      if (std::erase(expected, i) > 0) std::erase(found, i);
      tally.expect(found == expected, [&] { return test::text(tree.leaf(i)); });
    }
    EXPECT_TRUE(tally.result());
  }
}

TEST(Tree, OnePeriodicRootIsItsOwnNeighbour) {
  const Tree tree(filled(1), test::axes(true, true, true), 2);
  for (int dir = 0; dir < DIRECTIONS; ++dir) {
    EXPECT_EQ(tree.neighbour(0, dir).kind, Neighbour::Kind::same);
    EXPECT_EQ(tree.neighbour(0, dir).leaf, 0);
  }
  const Tree walls(filled(1), {}, 2);
  for (int dir = 0; dir < DIRECTIONS; ++dir) {
    if (dir != CENTRE) {
      EXPECT_EQ(walls.neighbour(0, dir).kind, Neighbour::Kind::boundary);
    }
  }
  // Refined once, every child meets every other one, across the domain too.
  const Tree finer = refined(tree, {{0, {}}});
  for (int i = 0; i < CHILDREN; ++i)
    EXPECT_EQ(finer.touching(i).size(), static_cast<std::size_t>(CHILDREN - 1));
}

TEST(Tree, RandomAdaptationGivesTheLeastBalancedTree) {
  Random random(14);
  int rounds = 0, coarsened = 0, spread = 0, refused = 0;
  for (const Forest& f : forests()) {
    Tree tree(f.roots, f.periodic, f.max_level);
    for (int round = 0; round < (DIM == 2 ? 40 : 12); ++round) {
      std::vector<std::int8_t> change = no_change(tree);
      const bool large = tree.size() > kMaxLeaves;
      const double refine = large ? 0.01 : 0.15, coarsen = large ? 0.98 : (round % 3 == 0 ? 0.9 : 0.3);
      for (std::int8_t& c : change) c = random.chance(refine) ? 1 : (random.chance(coarsen) ? -1 : 0);
      const Tree next = tree.adapted(change);
      ASSERT_TRUE(valid(next)) << "round " << round;
      ASSERT_EQ(next.root_blocks(), tree.root_blocks());
      ASSERT_EQ(next.periodic(), tree.periodic());
      ASSERT_EQ(next.max_level(), tree.max_level());
      int finest = 0;
      for (const BlockIndex& leaf : next.leaves()) finest = std::max(finest, leaf.level);
      ASSERT_EQ(next.finest_level(), finest);

      for (int i = 0; i < tree.size(); ++i) {
        const BlockIndex leaf = tree.leaf(i);
        const int ask = change[static_cast<std::size_t>(i)];
        const BlockIndex covers = next.leaf(next.locate(leaf));  // first leaf below where it was refined
        if (ask > 0 && leaf.level < tree.max_level()) {
          ASSERT_EQ(covers, child_of(leaf, 0)) << "a refinement was not granted";
        }
        if (covers.level < leaf.level) {
          ++coarsened;
          for (int child = 0; child < CHILDREN; ++child) {
            const int sibling = tree.find(child_of(parent_of(leaf), child));
            ASSERT_GE(sibling, 0);
            ASSERT_LT(change[static_cast<std::size_t>(sibling)], 0)
                << "coarsened against the will of a sibling";
          }
        }
        if (ask <= 0 && covers.level > leaf.level) ++spread;
        if (ask < 0 && covers.level == leaf.level) ++refused;
      }
      const std::set<BlockIndex> expected = adapted_by_trial(tree, change);
      ASSERT_EQ(std::set<BlockIndex>(next.leaves().begin(), next.leaves().end()), expected)
          << "round " << round;
      tree = next;
      ++rounds;
    }
  }
  EXPECT_GT(coarsened, rounds);
  EXPECT_GT(spread, rounds / 4);
  EXPECT_GT(refused, rounds);
}

TEST(Tree, NoRequestNoChange) {
  Random random(15);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    EXPECT_EQ(leaves_of(tree.adapted(no_change(tree))), leaves_of(tree));
  }
}

TEST(Tree, RequestsBeyondTheLevelsAreIgnored) {
  const Tree roots(filled(2), {}, 1);
  EXPECT_EQ(leaves_of(roots.adapted(std::vector<std::int8_t>(static_cast<std::size_t>(roots.size()), -1))),
            leaves_of(roots));
  const Tree finest = roots.adapted(std::vector<std::int8_t>(static_cast<std::size_t>(roots.size()), 1));
  EXPECT_EQ(finest.size(), CHILDREN * roots.size());
  EXPECT_EQ(leaves_of(finest.adapted(std::vector<std::int8_t>(static_cast<std::size_t>(finest.size()), 1))),
            leaves_of(finest));
}

TEST(Tree, OneSiblingKeepsTheFamily) {
  Tree tree = refined(Tree(filled(1), {}, 2), {{0, {}}});
  for (int stubborn = 0; stubborn < CHILDREN; ++stubborn) {
    std::vector<std::int8_t> change(static_cast<std::size_t>(CHILDREN), -1);
    change[static_cast<std::size_t>(stubborn)] = 0;
    EXPECT_EQ(leaves_of(tree.adapted(change)), leaves_of(tree));
  }
  EXPECT_EQ(tree.adapted(std::vector<std::int8_t>(static_cast<std::size_t>(CHILDREN), -1)).size(), 1);
}

TEST(Tree, CoarsensBackToTheRoots) {
  Random random(16);
  for (const Forest& f : forests()) {
    Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    for (int level = 0; level < f.max_level; ++level) {
      tree = tree.adapted(std::vector<std::int8_t>(static_cast<std::size_t>(tree.size()), -1));
    }
    EXPECT_EQ(leaves_of(tree), leaves_of(Tree(f.roots, f.periodic, f.max_level)));
  }
}

TEST(Tree, RefinesOneCornerToTheDeepestLevel) {
  int deepest = 0;
  for (const IntVec& roots : {test::vec(1, 1, 1), test::vec(2, 1, 2), test::vec(5, 3, 4)}) {
    for (const bool high : {false, true}) {
      // A forest whose curve does not fit into a key is refused, not mistaken for another one.
      std::optional<Tree> tree;
      try {
        tree.emplace(roots, Array<bool>{}, 20);
      } catch (const std::invalid_argument&) {
        continue;
      }
      for (int level = 0; level < 20; ++level) {
        IntVec corner{};
        for (int a = 0; a < DIM; ++a) corner[a] = high ? (roots[a] << level) - 1 : 0;
        ASSERT_GE(tree->find({level, corner}), 0) << test::text(roots) << " level " << level;
        tree = refined(*tree, {{level, corner}});
      }
      EXPECT_EQ(tree->finest_level(), 20);
      EXPECT_TRUE(Model(*tree).balanced()) << test::text(roots);
      for (int i = 0; i + 1 < tree->size(); ++i) {
        ASSERT_LT(morton(tree->leaf(i), 20), morton(tree->leaf(i + 1), 20)) << test::text(roots);
      }
      ++deepest;
    }
  }
  EXPECT_GE(deepest, 4) << "up to two roots a side must be granted";
}

TEST(Tree, RefusesMoreBlocksAlongAnAxisThanItsKeysHold) {
  for (const int level : {0, 10, 20}) {
    const auto most = static_cast<int>(Tree::MOST_ALONG_AXIS >> level);
    for (int a = 0; a < DIM; ++a) {
      IntVec roots = filled(1);
      roots[a] = most;
      EXPECT_TRUE(Tree::fits(roots, level)) << test::text(roots) << " level " << level;
      ++roots[a];
      EXPECT_FALSE(Tree::fits(roots, level)) << test::text(roots) << " level " << level;
      try {
        const Tree tree(roots, Array<bool>{}, level);
        ADD_FAILURE() << test::text(roots) << " level " << level << " was granted";
      } catch (const std::invalid_argument& e) {
        EXPECT_NE(std::string(e.what()).find("along an axis"), std::string::npos) << e.what();
      }
    }
  }
}

TEST(Tree, FromLeavesInAnyOrder) {
  Random random(17);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    std::vector<BlockIndex> leaves = leaves_of(tree);
    random.shuffle(leaves);
    const Tree again = with_leaves(tree, leaves);
    EXPECT_EQ(leaves_of(again), leaves_of(tree));
    for (int i = 0; i < tree.size(); i += 7) EXPECT_EQ(again.touching(i), tree.touching(i));
  }
}

TEST(Tree, FromLeavesRejectsOverlaps) {
  Random random(18);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    const std::vector<BlockIndex> leaves = leaves_of(tree);
    const auto at = [&](int i) { return leaves[static_cast<std::size_t>(i)]; };
    for (int trial = 0; trial < 10; ++trial) {
      const int i = random.below(tree.size());
      std::vector<BlockIndex> twice = leaves;
      twice.push_back(at(i));
      EXPECT_THROW(with_leaves(tree, twice), std::invalid_argument);
      // The right number of leaves and even the right volume: one leaf takes the place of another of its
      // level.
      for (int j = 0; j < tree.size(); ++j) {
        if (j == i || at(j).level != at(i).level) continue;
        std::vector<BlockIndex> shadowed = leaves;
        shadowed[static_cast<std::size_t>(j)] = at(i);
        EXPECT_THROW(with_leaves(tree, shadowed), std::invalid_argument);
        break;
      }
      if (at(i).level > 0) {
        std::vector<BlockIndex> buried = leaves;
        buried.push_back(parent_of(at(i)));
        EXPECT_THROW(with_leaves(tree, buried), std::invalid_argument);
      }
      if (at(i).level < f.max_level) {
        std::vector<BlockIndex> sprouting = leaves;
        sprouting.push_back(child_of(at(i), random.below(CHILDREN)));
        EXPECT_THROW(with_leaves(tree, sprouting), std::invalid_argument);
      }
    }
  }
}

TEST(Tree, FromLeavesRejectsGaps) {
  Random random(19);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    for (int i : {0, tree.size() - 1, random.below(tree.size())}) {
      std::vector<BlockIndex> gap = leaves_of(tree);
      gap.erase(gap.begin() + i);
      EXPECT_THROW(with_leaves(tree, gap), std::invalid_argument) << "gap at " << i;
    }
    EXPECT_THROW(with_leaves(tree, {}), std::invalid_argument);
  }
}

TEST(Tree, FromLeavesRejectsLeavesOutsideTheDomain) {
  Random random(20);
  for (const Forest& f : forests()) {
    const Tree tree = test::random_tree(random, f.roots, f.periodic, f.max_level, kMaxLeaves);
    const std::vector<BlockIndex> leaves = leaves_of(tree);
    for (int a = 0; a < DIM; ++a) {
      for (const bool high : {false, true}) {  // instead of a leaf inside, or beside it
        const std::size_t i = static_cast<std::size_t>(random.below(tree.size()));
        std::vector<BlockIndex> moved = leaves, added = leaves;
        moved[i].coord[a] = high ? f.roots[a] << moved[i].level : -1;
        added.push_back(moved[i]);
        EXPECT_THROW(with_leaves(tree, moved), std::invalid_argument);
        EXPECT_THROW(with_leaves(tree, added), std::invalid_argument);
      }
    }
  }
}

TEST(Tree, FromLeavesRejectsImpossibleLevels) {
  for (const Forest& f : forests()) {
    const Tree shallow(f.roots, f.periodic, 1);
    std::vector<BlockIndex> too_fine;  // a fine tiling, but finer than max_level
    for (const BlockIndex& root : shallow.leaves())
      for (int child = 0; child < CHILDREN; ++child)
        for (int below = 0; below < CHILDREN; ++below)
          too_fine.push_back(child_of(child_of(root, child), below));
    EXPECT_THROW(with_leaves(shallow, too_fine), std::invalid_argument);
    for (const int level : {-1, -20, 1000}) {
      std::vector<BlockIndex> strange = leaves_of(shallow);
      strange[0].level = level;
      EXPECT_THROW(with_leaves(shallow, strange), std::invalid_argument) << "level " << level;
    }
  }
}

TEST(Tree, FromLeavesRejectsImbalance) {
  // Each direction in turn: the node there is a leaf of level 0, the block in the middle has leaves of level
  // 2 in the corner that faces it, so balance fails through that face, edge or corner alone.
  for (int dir = 0; dir < DIRECTIONS; ++dir) {
    if (dir == CENTRE) continue;
    const Tree tree = refined(Tree(filled(3), {}, 2), {{0, filled(1)}});
    IntVec corner = filled(2);
    int child = 0;
    for (int a = 0; a < DIM; ++a) {
      if (direction_offset(dir)[a] > 0) {
        ++corner[a];
        child |= 1 << a;
      }
    }
    // What the corner's children touch, other than the direction under test, is refined: only `dir` is at
    // fault.
    std::vector<BlockIndex> leaves;
    IntVec fault = filled(1);
    for (int a = 0; a < DIM; ++a) fault[a] += direction_offset(dir)[a];
    for (const BlockIndex& leaf : tree.leaves()) {
      if (leaf == BlockIndex{1, corner}) {
        for (int c = 0; c < CHILDREN; ++c) leaves.push_back(child_of(leaf, c));
      } else if (leaf.level == 0 && leaf.coord != fault) {
        for (int c = 0; c < CHILDREN; ++c) leaves.push_back(child_of(leaf, c));
      } else {
        leaves.push_back(leaf);
      }
    }
    EXPECT_THROW(with_leaves(tree, leaves), std::invalid_argument) << test::text(direction_offset(dir));
    std::erase(leaves, BlockIndex{0, fault});
    for (int c = 0; c < CHILDREN; ++c) leaves.push_back(child_of({0, fault}, c));
    EXPECT_NO_THROW(with_leaves(tree, leaves)) << test::text(direction_offset(dir));
  }
}

TEST(Tree, BalanceHoldsAcrossPeriodicSides) {
  // Fine at the low side of x, coarse at the high side: fine where there are walls, wrong where x is
  // periodic.
  const IntVec roots = test::vec(4, 1, 1);
  const Tree walls = refined(refined(Tree(roots, {}, 2), {{0, IntVec{}}}), {{1, IntVec{}}});
  EXPECT_EQ(walls.find({0, test::vec(3, 0, 0)}), walls.size() - 1);
  const Array<bool> periodic = test::axes(true, false, false);
  EXPECT_THROW(Tree(roots, periodic, 2, leaves_of(walls)), std::invalid_argument);
  EXPECT_NO_THROW(Tree(roots, {}, 2, leaves_of(walls)));
  const Tree wrapped = refined(refined(Tree(roots, periodic, 2), {{0, IntVec{}}}), {{1, IntVec{}}});
  EXPECT_EQ(wrapped.find({0, test::vec(3, 0, 0)}), -1) << "refinement spreads around the axis";
  EXPECT_TRUE(valid(wrapped));
}

TEST(Dim, DirectionsAndFacesAreNumberedConsistently) {
  for (int dir = 0; dir < DIRECTIONS; ++dir) EXPECT_EQ(direction_index(direction_offset(dir)), dir);
  EXPECT_EQ(direction_offset(CENTRE), IntVec{});
  EXPECT_EQ(direction_offset(CENTRE + 1), test::vec(1, 0, 0)) << "x varies fastest";
  EXPECT_EQ(direction_offset(CENTRE + 3), test::vec(0, 1, 0));
  for (int face = 0; face < FACES; ++face) {
    IntVec offset{};
    offset[face / 2] = face % 2 == 0 ? -1 : 1;
    EXPECT_EQ(face_axis(face), face / 2);
    EXPECT_EQ(face_is_high(face), face % 2 == 1);
    EXPECT_EQ(face_offset(face), offset);
  }
  EXPECT_EQ(volume(test::vec(7, 11, 13)), DIM == 2 ? 77 : 1001);
}

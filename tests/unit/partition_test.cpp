// Who owns which block: balance, contiguity, and the same answer everywhere.
#include "amr/partition.hpp"

#include <gtest/gtest.h>
#include <mpi.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <set>
#include <vector>

#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Random;

namespace {

std::vector<double> loads(const std::vector<double>& weights, const std::vector<int>& owners, int ranks) {
  std::vector<double> load(static_cast<std::size_t>(ranks), 0.0);
  for (std::size_t i = 0; i < weights.size(); ++i) load[static_cast<std::size_t>(owners[i])] += weights[i];
  return load;
}

testing::AssertionResult owned(const std::vector<int>& owners, std::size_t leaves, int ranks) {
  if (owners.size() != leaves) return testing::AssertionFailure() << owners.size() << " owners of " << leaves;
  for (const int owner : owners) {
    if (owner < 0 || owner >= ranks)
      return testing::AssertionFailure() << "owner " << owner << " of " << ranks;
  }
  return testing::AssertionSuccess();
}

std::vector<double> random_weights(Random& random, int count, double spread) {
  std::vector<double> weights(static_cast<std::size_t>(count));
  for (double& w : weights) w = std::exp(spread * random.symmetric());
  return weights;
}

/// A tree of a few hundred leaves, half of them around one corner.
Tree big_tree(std::uint64_t seed) {
  Random random(seed);
  return test::random_tree(random, DIM == 2 ? filled(6) : filled(3), test::axes(true, false, false), 3,
                           DIM == 2 ? 900 : 1200, 12);
}

/// Faces between blocks of different owners.
int cut(const Tree& tree, const std::vector<int>& owners) {
  int faces = 0;
  for (int i = 0; i < tree.size(); ++i) {
    for (int face = 0; face < FACES; ++face) {
      const Neighbour n = tree.neighbour(i, direction_index(face_offset(face)));
      if (n.leaf >= 0 && owners[static_cast<std::size_t>(n.leaf)] != owners[static_cast<std::size_t>(i)])
        ++faces;
    }
  }
  return faces;
}

}  // namespace

TEST(Partition, CurveIsContiguousAndBalanced) {
  Random random(1);
  for (int trial = 0; trial < 400; ++trial) {
    const int leaves = 1 + random.below(300), ranks = 1 + random.below(trial % 4 == 0 ? 400 : 20);
    const std::vector<double> weights = random_weights(random, leaves, trial % 3 * 1.5);
    const std::vector<int> owners = partition_curve(weights, ranks);
    ASSERT_TRUE(owned(owners, weights.size(), ranks));
    ASSERT_TRUE(std::is_sorted(owners.begin(), owners.end()))
        << "pieces of the curve, in the order of the ranks";
    const double mean = std::accumulate(weights.begin(), weights.end(), 0.0) / ranks;
    const double block = *std::max_element(weights.begin(), weights.end());
    for (const double load : loads(weights, owners, ranks)) {
      ASSERT_LE(std::abs(load - mean), block * (1 + 1e-12)) << leaves << " leaves on " << ranks << " ranks";
    }
  }
}

TEST(Partition, CurveOfEqualWeights) {
  for (int ranks = 1; ranks <= 40; ++ranks) {
    for (int leaves = 1; leaves <= 130; leaves += 3) {
      const std::vector<double> weights(static_cast<std::size_t>(leaves), 0.7);
      const std::vector<int> owners = partition_curve(weights, ranks);
      ASSERT_TRUE(owned(owners, weights.size(), ranks));
      for (const double load : loads(weights, owners, ranks)) {
        // Equal blocks can be dealt out to within one; nobody is idle unless there are too few of them.
        const int blocks = static_cast<int>(std::lround(load / 0.7));
        ASSERT_GE(blocks, leaves / ranks) << leaves << " leaves on " << ranks << " ranks";
        ASSERT_LE(blocks, (leaves + ranks - 1) / ranks) << leaves << " leaves on " << ranks << " ranks";
      }
    }
  }
}

TEST(Partition, MoreRanksThanLeaves) {
  const Tree tree(test::vec(3, 1, 1), {}, 1);
  for (const int ranks : {3, 4, 7, 64}) {
    const std::vector<double> weights{1, 1, 1};
    for (const Partitioner kind : {Partitioner::curve, Partitioner::graph}) {
      const std::vector<int> owners = partition(kind, tree, weights, ranks);
      ASSERT_TRUE(owned(owners, 3, ranks));
    }
    const std::vector<int> owners = partition(Partitioner::curve, tree, weights, ranks);
    EXPECT_EQ(std::set<int>(owners.begin(), owners.end()).size(), 3U) << "one block each";
  }
  const Tree one(filled(1), test::axes(true, true, true), 0);
  for (const int ranks : {1, 2, 5}) {
    EXPECT_TRUE(owned(partition_curve(std::vector<double>{2.5}, ranks), 1, ranks));
    EXPECT_TRUE(owned(partition_graph(one, std::vector<double>{2.5}, ranks), 1, ranks));
  }
}

TEST(Partition, GraphIsBalancedOnBigTree) {
  const Tree tree = big_tree(2);
  ASSERT_GT(tree.size(), 300);
  Random random(3);
  for (const int ranks : {1, 2, 3, 4, 7, 12}) {
    for (const double spread : {0.0, 0.7}) {
      for (const double unit :
           {1.0, 1e-9, 3e7}) {  // seconds, counts: the scale of the weights is nobody's business
        std::vector<double> weights = random_weights(random, tree.size(), spread);
        for (double& w : weights) w *= unit;
        const std::vector<int> owners = partition_graph(tree, weights, ranks);
        ASSERT_TRUE(owned(owners, weights.size(), ranks));
        EXPECT_LE(imbalance(weights, owners, ranks), 1.1)
            << ranks << " ranks, spread " << spread << ", unit " << unit;
      }
    }
  }
}

TEST(Partition, GraphKeepsNeighboursTogether) {
  const Tree tree = big_tree(4);
  const std::vector<double> weights(static_cast<std::size_t>(tree.size()), 1.0);
  const int ranks = 4;
  std::vector<int> dealt(weights.size());
  for (std::size_t i = 0; i < dealt.size(); ++i) dealt[i] = static_cast<int>(i) % ranks;
  const int graph = cut(tree, partition_graph(tree, weights, ranks));
  EXPECT_LT(3 * graph, cut(tree, dealt));
  EXPECT_LT(graph, 1.1 * cut(tree, partition_curve(weights, ranks)))
      << "worse than the curve: what is it for?";
}

TEST(Partition, DispatchesToEitherKind) {
  const Tree tree = big_tree(5);
  Random random(6);
  const std::vector<double> weights = random_weights(random, tree.size(), 1.0);
  EXPECT_EQ(partition(Partitioner::curve, tree, weights, 5), partition_curve(weights, 5));
  EXPECT_EQ(partition(Partitioner::graph, tree, weights, 5), partition_graph(tree, weights, 5));
}

TEST(Partition, ImbalanceIsLargestOverMean) {
  const std::vector<double> weights{1, 2, 3};
  EXPECT_DOUBLE_EQ(imbalance(weights, std::vector<int>{0, 0, 0}, 1), 1);
  EXPECT_DOUBLE_EQ(imbalance(weights, std::vector<int>{0, 0, 1}, 2), 1);
  EXPECT_DOUBLE_EQ(imbalance(weights, std::vector<int>{1, 0, 1}, 2), 4.0 / 3);
  EXPECT_DOUBLE_EQ(imbalance(weights, std::vector<int>{0, 0, 1}, 3), 1.5) << "a rank without blocks counts";
}

TEST(MpiPartition, EveryRankComputesTheSame) {
  Random random(7);
  for (int trial = 0; trial < 5; ++trial) {
    const Tree tree = big_tree(static_cast<std::uint64_t>(10 + trial));
    const std::vector<double> weights = random_weights(random, tree.size(), 1.0);
    for (const Partitioner kind : {Partitioner::curve, Partitioner::graph}) {
      const std::vector<int> mine = partition(kind, tree, weights, 2 + trial);
      EXPECT_EQ(partition(kind, tree, weights, 2 + trial), mine) << "twice";
      std::vector<int> roots = mine;
      MPI_Bcast(roots.data(), static_cast<int>(roots.size()), MPI_INT, 0, MPI_COMM_WORLD);
      EXPECT_EQ(mine, roots);
    }
  }
}

/// \file
/// The topology of the mesh: leaves of a forest of quadtrees (octrees), known to every rank.
#pragma once

#include <compare>
#include <cstdint>
#include <span>
#include <vector>

#include "amr/dim.hpp"

namespace dendrift::amr {

/// A node of the forest: `coord` counts blocks of `level` from the low corner of the domain.
struct BlockIndex {
  int level = 0;
  IntVec coord{};
  auto operator<=>(const BlockIndex&) const = default;
};

/// What lies across one direction of a leaf. 2:1 balance holds through faces, edges and corners.
struct Neighbour {
  enum class Kind : std::uint8_t { boundary, same, coarser, finer };
  Kind kind = Kind::boundary;
  int leaf = -1;  ///< same, coarser: the leaf; finer: -1, see Tree::finer_neighbours
};

/// A finer leaf across one direction, and which child of the (refined) neighbour it is.
struct FinerNeighbour {
  int leaf;
  IntVec child;  ///< 0 or 1 along each axis
};

/// Sorted leaves of the forest. Leaves are numbered along the Morton curve; the numbering, and every
/// result of this class, is the same on all ranks. Immutable: adapted() returns a new tree.
class Tree {
 public:
  /// Blocks of the finest level that an axis can have: the sorting key of a leaf has 64 bits for all axes.
  static constexpr std::int64_t MOST_ALONG_AXIS = std::int64_t{1} << (DIM == 2 ? 30 : 21);
  static bool fits(const IntVec& root_blocks, int max_level);

  /// All root blocks as leaves of level 0. max_level <= 20; throws std::invalid_argument where `fits` is false.
  Tree(IntVec root_blocks, Array<bool> periodic, int max_level);
  /// A given set of leaves (a restart); throws std::invalid_argument unless it tiles the domain and is balanced.
  Tree(IntVec root_blocks, Array<bool> periodic, int max_level, std::vector<BlockIndex> leaves);

  int size() const { return static_cast<int>(leaves_.size()); }
  const BlockIndex& leaf(int i) const { return leaves_[static_cast<std::size_t>(i)]; }
  std::span<const BlockIndex> leaves() const { return leaves_; }
  IntVec root_blocks() const { return root_blocks_; }
  Array<bool> periodic() const { return periodic_; }
  int max_level() const { return max_level_; }
  int finest_level() const;  ///< of the leaves there are

  /// Leaf that covers the node, or the first of the leaves below it. The node must lie in the domain.
  int locate(const BlockIndex& node) const;
  /// Index of exactly this leaf, or -1.
  int find(const BlockIndex& node) const;

  Neighbour neighbour(int leaf, int direction) const {
    return neighbours_[static_cast<std::size_t>(leaf) * DIRECTIONS + static_cast<std::size_t>(direction)];
  }
  /// Leaves of the next finer level that touch `leaf` in `direction`; appended to `out`.
  void finer_neighbours(int leaf, int direction, std::vector<FinerNeighbour>& out) const;
  /// All leaves that touch `leaf` (through faces, edges or corners), sorted, without repetition.
  std::vector<int> touching(int leaf) const;

  /// The tree after refining (+1) and coarsening (-1) leaves. Refinement is always granted and spreads as 2:1
  /// balance demands; a family is coarsened only if all its members ask for it and balance allows.
  Tree adapted(std::span<const std::int8_t> change) const;

 private:
  std::uint64_t key(const BlockIndex& node) const;
  bool inside(BlockIndex& node) const;  // wraps periodic axes; false beyond a wall
  void index_leaves();
  void validate() const;
  std::vector<std::int8_t> balanced(std::span<const std::int8_t> change) const;

  IntVec root_blocks_;
  Array<bool> periodic_;
  int max_level_;
  std::vector<BlockIndex> leaves_;
  std::vector<std::uint64_t> keys_;
  std::vector<Neighbour> neighbours_;
};

}  // namespace dendrift::amr

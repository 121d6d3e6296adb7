/// \file
/// The mesh: tree, distribution over ranks, and the arrays of this rank's blocks.
#pragma once

#include <mpi.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <span>
#include <vector>

#include "amr/field.hpp"
#include "amr/tree.hpp"

namespace dendrift::amr {

/// Shape of every array of a block: n cells a side inside GHOSTS layers, x fastest. Indices count from the
/// first interior cell, so ghost cells have indices -GHOSTS..-1 and n..n+GHOSTS-1.
struct Layout {
  static constexpr int GHOSTS = 2;
  int n = 16;

  constexpr int pitch() const { return n + 2 * GHOSTS; }
  constexpr std::ptrdiff_t stride(int axis) const {
    std::ptrdiff_t s = 1;
    for (int a = 0; a < axis; ++a) s *= pitch();
    return s;
  }
  constexpr std::ptrdiff_t offset(const IntVec& cell) const {
    std::ptrdiff_t o = 0;
    for (int a = 0; a < DIM; ++a) o += cell[a] * stride(a);
    return o;
  }
  constexpr std::ptrdiff_t interior() const { return offset(filled(GHOSTS)); }
  constexpr std::ptrdiff_t size() const { return stride(DIM); }
};

/// Whether all cells of an array, ghosts included, hold the same; values: cell (0,0[,0]).
inline bool uniform(const double* values, const Layout& layout) {
  const double* p = values - layout.interior();
  return std::all_of(p, p + layout.size(), [&](double x) { return x == *p; });
}

/// A leaf owned by this rank.
struct Block {
  int leaf = -1;  ///< number in the tree
  int slot = -1;  ///< where its arrays are
  BlockIndex index;
  double dx = 0;  ///< cell spacing
  RealVec lo{};   ///< low corner

  RealVec centre(const IntVec& cell) const {
    RealVec x{};
    for (int a = 0; a < DIM; ++a) x[a] = lo[a] + (cell[a] + 0.5) * dx;
    return x;
  }
  /// Centre and radius of the ball round a block of n cells a side.
  RealVec middle(int n) const {
    RealVec x = lo;
    for (double& y : x) y += 0.5 * n * dx;
    return x;
  }
  double ball(int n) const { return 0.5 * n * dx * std::sqrt(static_cast<double>(DIM)); }
};

enum class Side : std::uint8_t { wall, symmetry, open, periodic };

struct MeshShape {
  IntVec root_blocks{};
  int max_level = 0;
  int block_cells = 16;         ///< cells along a side of a block: 8, 16 or 32
  RealVec lo{};                 ///< low corner of the domain
  double root_dx = 1;           ///< cell spacing on level 0
  std::array<Side, FACES> sides{};

  Array<bool> periodic() const;
  double dx(int level) const { return root_dx / static_cast<double>(1 << level); }
  RealVec hi() const;
  /// The way from one point to another, or to its nearest image.
  RealVec way(const RealVec& from, const RealVec& to) const;
};

/// Owns the arrays. Lengths are in the unit of MeshShape (Dendrift: W0). All ranks hold the same tree and owners.
class Mesh {
 public:
  Mesh(const MeshShape& shape, const FieldTable& fields, MPI_Comm comm);

  const MeshShape& shape() const { return shape_; }
  const FieldTable& fields() const { return fields_; }
  const Layout& layout() const { return layout_; }
  MPI_Comm comm() const { return comm_; }
  int rank() const { return rank_; }
  int ranks() const { return ranks_; }
  const Tree& tree() const { return tree_; }
  std::span<const int> owners() const { return owners_; }
  int owner(int leaf) const { return owners_[static_cast<std::size_t>(leaf)]; }

  int size() const { return static_cast<int>(blocks_.size()); }  ///< blocks of this rank
  const Block& block(int b) const { return blocks_[static_cast<std::size_t>(b)]; }
  std::span<const Block> blocks() const { return blocks_; }
  int local(int leaf) const { return local_of_leaf_[static_cast<std::size_t>(leaf)]; }  ///< -1: not ours

  /// Cell (0,0[,0]) of a field in local block b; neighbours are reached by Layout strides.
  double* cells(CellField f, int b) { return array(f.id, block(b).slot); }
  const double* cells(CellField f, int b) const { return array(f.id, block(b).slot); }
  double* faces(FaceField f, int axis, int b) { return array(f.id + axis, block(b).slot); }
  const double* faces(FaceField f, int axis, int b) const { return array(f.id + axis, block(b).slot); }

  /// Exchanges the arrays of two cell fields in all blocks at no cost.
  void swap(CellField a, CellField b);

  /// Low corner and spacing of a tree node.
  Block describe(const BlockIndex& index) const;
  /// Value of a rank-independent identifier: counts changes of the tree or of the owners.
  std::int64_t generation() const { return generation_; }
  std::int64_t bytes() const;  ///< held by the arrays of this rank

  // For regridding, which builds the next set of blocks while the old one is still there.
  int acquire_slot();
  void release_slot(int slot);
  double* array(int field, int slot) {
    return slots_[static_cast<std::size_t>(slot)].get() + position_[static_cast<std::size_t>(field)] + layout_.interior();
  }
  const double* array(int field, int slot) const {
    return slots_[static_cast<std::size_t>(slot)].get() + position_[static_cast<std::size_t>(field)] + layout_.interior();
  }
  /// Installs a tree and its owners. `slot_of_leaf[i]` is the filled slot of leaf i where this rank owns it
  /// (-1: a fresh slot is taken). Slots that are no longer used must have been released.
  void install(Tree tree, std::vector<int> owners, std::span<const int> slot_of_leaf);

 private:
  struct Free {
    void operator()(double* p) const;
  };
  MeshShape shape_;
  FieldTable fields_;
  Layout layout_;
  MPI_Comm comm_;
  int rank_ = 0;
  int ranks_ = 1;
  Tree tree_;
  std::vector<int> owners_;
  std::vector<Block> blocks_;
  std::vector<int> local_of_leaf_;
  std::vector<std::unique_ptr<double[], Free>> slots_;
  std::vector<int> free_slots_;
  std::vector<std::ptrdiff_t> position_;  // of each field's array inside a slot
  std::int64_t generation_ = 0;
};

}  // namespace dendrift::amr

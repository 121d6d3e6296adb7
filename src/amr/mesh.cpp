#include "amr/mesh.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <new>
#include <numeric>

#include "amr/partition.hpp"

namespace dendrift::amr {

namespace {

constexpr std::size_t ALIGNMENT = 64;  // bytes: a cache line, and the widest SIMD register

std::ptrdiff_t padded(std::ptrdiff_t doubles) {
  constexpr std::ptrdiff_t unit = ALIGNMENT / sizeof(double);
  return (doubles + unit - 1) / unit * unit;
}

}  // namespace

Array<bool> MeshShape::periodic() const {
  Array<bool> p{};
  for (int a = 0; a < DIM; ++a) p[a] = sides[static_cast<std::size_t>(2 * a)] == Side::periodic;
  return p;
}

RealVec MeshShape::hi() const {
  RealVec h = lo;
  for (int a = 0; a < DIM; ++a) h[a] += root_blocks[a] * block_cells * root_dx;
  return h;
}

RealVec MeshShape::way(const RealVec& from, const RealVec& to) const {
  RealVec r{};
  for (int a = 0; a < DIM; ++a) {
    r[a] = to[a] - from[a];
    if (sides[static_cast<std::size_t>(2 * a)] != Side::periodic) continue;
    const double extent = root_blocks[a] * block_cells * root_dx;
    r[a] -= extent * std::round(r[a] / extent);
  }
  return r;
}

void Mesh::Free::operator()(double* p) const { std::free(p); }

Mesh::Mesh(const MeshShape& shape, const FieldTable& fields, MPI_Comm comm)
    : shape_(shape),
      fields_(fields),
      layout_{shape.block_cells},
      comm_(comm),
      tree_(shape.root_blocks, shape.periodic(), shape.max_level) {
  MPI_Comm_rank(comm, &rank_);
  MPI_Comm_size(comm, &ranks_);
  for (int i = 0; i < fields_.size(); ++i) position_.push_back(i * padded(layout_.size()));
  const std::vector<double> weights(static_cast<std::size_t>(tree_.size()), 1.0);
  const std::vector<int> none(weights.size(), -1);
  install(tree_, partition_curve(weights, ranks_), none);
}

void Mesh::swap(CellField a, CellField b) {
  std::swap(position_[static_cast<std::size_t>(a.id)], position_[static_cast<std::size_t>(b.id)]);
}

Block Mesh::describe(const BlockIndex& index) const {
  Block b;
  b.index = index;
  b.dx = shape_.dx(index.level);
  for (int a = 0; a < DIM; ++a) b.lo[a] = shape_.lo[a] + index.coord[a] * layout_.n * b.dx;
  return b;
}

std::int64_t Mesh::bytes() const {
  return static_cast<std::int64_t>(slots_.size()) * fields_.size() * padded(layout_.size()) *
         static_cast<std::int64_t>(sizeof(double));
}

int Mesh::acquire_slot() {
  if (free_slots_.empty()) {
    const auto doubles = static_cast<std::size_t>(fields_.size() * padded(layout_.size()));
    void* memory = std::aligned_alloc(ALIGNMENT, doubles * sizeof(double));
    if (memory == nullptr) throw std::bad_alloc();
    auto* p = static_cast<double*>(memory);
    slots_.emplace_back(p);
    free_slots_.push_back(static_cast<int>(slots_.size()) - 1);
  }
  const int slot = free_slots_.back();
  free_slots_.pop_back();
  // Ghost cells that nothing fills (beyond walls before the first exchange) must never hold signalling rubbish.
  double* p = slots_[static_cast<std::size_t>(slot)].get();
  std::fill_n(p, fields_.size() * padded(layout_.size()), 0.0);
  return slot;
}

void Mesh::release_slot(int slot) { free_slots_.push_back(slot); }

void Mesh::install(Tree tree, std::vector<int> owners, std::span<const int> slot_of_leaf) {
  tree_ = std::move(tree);
  owners_ = std::move(owners);
  std::vector<Block> blocks;
  local_of_leaf_.assign(owners_.size(), -1);
  for (int i = 0; i < tree_.size(); ++i) {
    if (owner(i) != rank_) continue;
    Block b = describe(tree_.leaf(i));
    b.leaf = i;
    const int slot = slot_of_leaf[static_cast<std::size_t>(i)];
    b.slot = slot >= 0 ? slot : acquire_slot();
    local_of_leaf_[static_cast<std::size_t>(i)] = static_cast<int>(blocks.size());
    blocks.push_back(b);
  }
  blocks_ = std::move(blocks);
  ++generation_;
}

}  // namespace dendrift::amr

/// \file
/// What the tests of the mesh share: reproducible randomness, random trees, polynomials with their cell
/// means, and a slow but obvious answer to "what does this cell hold?".
#pragma once

#include <gtest/gtest.h>
#include <mpi.h>

#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <random>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "amr/mesh.hpp"
#include "amr/partition.hpp"
#include "amr/transfer.hpp"

namespace dendrift::test {

/// The same numbers on every rank and with every standard library.
class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}
  std::uint64_t bits() { return engine_(); }
  int below(int n) { return static_cast<int>(engine_() % static_cast<std::uint64_t>(n)); }
  double unit() { return std::ldexp(static_cast<double>(engine_() >> 11), -53); }  ///< in [0,1)
  double symmetric() { return 2 * unit() - 1; }
  bool chance(double p) { return unit() < p; }
  template <class T>
  void shuffle(std::vector<T>& v) {
    for (std::size_t i = v.size(); i > 1; --i) std::swap(v[i - 1], v[engine_() % i]);
  }

 private:
  std::mt19937_64 engine_;
};

/// A number in [-1,1) that depends on all the arguments and on nothing else: data that every rank can make
/// anew.
template <class... Ints>
double noise(Ints... ints) {
  std::uint64_t h = 0x9e3779b97f4a7c15ULL;
  const auto mix = [&h](std::uint64_t x) {
    h = (h ^ x) * 0xbf58476d1ce4e5b9ULL;
    h ^= h >> 29;
    h *= 0x94d049bb133111ebULL;
    h ^= h >> 32;
  };
  (mix(static_cast<std::uint64_t>(ints)), ...);
  return std::ldexp(static_cast<double>(h >> 11), -52) - 1;
}

/// The first DIM of three numbers.
inline IntVec vec(int x, int y, int z) {
  const std::array<int, 3> v{x, y, z};
  IntVec r{};
  for (int a = 0; a < DIM; ++a) r[a] = v[a];
  return r;
}

inline Array<bool> axes(bool x, bool y, bool z) {
  const std::array<bool, 3> v{x, y, z};
  Array<bool> r{};
  for (int a = 0; a < DIM; ++a) r[a] = v[a];
  return r;
}

inline int ranks_of(MPI_Comm comm) {
  int ranks = 0;
  MPI_Comm_size(comm, &ranks);
  return ranks;
}

inline bool same_bits(double a, double b) {
  return std::bit_cast<std::uint64_t>(a) == std::bit_cast<std::uint64_t>(b);
}

template <class Vec>
std::string text(const Vec& v) {
  std::ostringstream s;
  s << "(";
  for (std::size_t a = 0; a < v.size(); ++a) s << (a > 0 ? "," : "") << v[a];
  s << ")";
  return s.str();
}
inline std::string text(const amr::BlockIndex& b) {
  return "level " + std::to_string(b.level) + " " + text(b.coord);
}

/// Counts comparisons and remembers the first that failed: one line of report for a million cells.
class Tally {
 public:
  template <class Describe>
  void expect(bool ok, Describe&& describe) {
    ++checks_;
    if (ok) return;
    if (failures_++ == 0) first_ = describe();
  }
  template <class Describe>
  void near(double got, double want, double tolerance, Describe&& describe) {
    expect(std::abs(got - want) <= tolerance, [&] {
      std::ostringstream s;
      s.precision(17);
      s << describe() << ": got " << got << ", expected " << want;
      return s.str();
    });
  }
  template <class Describe>
  void bits(double got, double want, Describe&& describe) {
    expect(same_bits(got, want), [&] {
      std::ostringstream s;
      s.precision(17);
      s << describe() << ": got " << got << ", expected the bits of " << want;
      return s.str();
    });
  }
  std::int64_t checks() const { return checks_; }
  ::testing::AssertionResult result() const {
    if (failures_ == 0) return ::testing::AssertionSuccess();
    return ::testing::AssertionFailure()
           << failures_ << " of " << checks_ << " comparisons failed, first: " << first_;
  }

 private:
  std::int64_t checks_ = 0, failures_ = 0;
  std::string first_;
};

/// Sum over the ranks, so that a test may demand that something was checked at all.
inline std::int64_t over_ranks(std::int64_t mine, MPI_Comm comm) {
  std::int64_t all = 0;
  MPI_Allreduce(&mine, &all, 1, MPI_INT64_T, MPI_SUM, comm);
  return all;
}

/// Refines and coarsens at random; stays below about `max_leaves`.
inline amr::Tree random_tree(Random& random, const IntVec& roots, const Array<bool>& periodic, int max_level,
                             int max_leaves, int rounds = 8) {
  amr::Tree tree(roots, periodic, max_level);
  for (int round = 0; round < rounds; ++round) {
    // One leaf refined brings CHILDREN - 1 more, and balance asks for as much again.
    const double room = static_cast<double>(max_leaves - tree.size()) / (2.0 * CHILDREN);
    const double refine = std::min(0.4, room / tree.size());
    const double coarsen = round % 3 == 2 ? 0.6 : 0.1;
    std::vector<std::int8_t> change(static_cast<std::size_t>(tree.size()));
    for (std::int8_t& c : change) c = random.chance(refine) ? 1 : (random.chance(coarsen) ? -1 : 0);
    tree = tree.adapted(change);
  }
  return tree;
}

/// Sides follow from `periodic`; lengths are powers of two, so that positions carry no rounding.
inline amr::MeshShape shape_of(const IntVec& roots, const Array<bool>& periodic, int max_level,
                               int block_cells = 8) {
  amr::MeshShape shape;
  shape.root_blocks = roots;
  shape.max_level = max_level;
  shape.block_cells = block_cells;
  shape.root_dx = 0.25;
  for (int a = 0; a < DIM; ++a) {
    shape.lo[a] = -0.5 * (a + 1);
    shape.sides[2 * a] = shape.sides[2 * a + 1] = periodic[a] ? amr::Side::periodic : amr::Side::wall;
  }
  return shape;
}

/// How a test deals blocks out to ranks.
enum class Deal : std::uint8_t { curve, graph, scattered };
inline constexpr std::array<Deal, 3> kDeals{Deal::curve, Deal::graph, Deal::scattered};

inline std::vector<int> deal_out(Deal deal, const amr::Tree& tree, int ranks, Random& random) {
  const std::vector<double> weights(static_cast<std::size_t>(tree.size()), 1.0);
  std::vector<int> scattered(weights.size());
  for (int& owner : scattered)
    owner = random.below(ranks);  // drawn always: later draws must not depend on `deal`
  if (deal == Deal::curve) return amr::partition(amr::Partitioner::curve, tree, weights, ranks);
  if (deal == Deal::graph) return amr::partition(amr::Partitioner::graph, tree, weights, ranks);
  return scattered;
}

/// Puts another tree in place; the data are lost.
inline void put(amr::Mesh& mesh, amr::Tree tree, std::vector<int> owners) {
  for (const amr::Block& block : mesh.blocks()) mesh.release_slot(block.slot);
  const std::vector<int> fresh(static_cast<std::size_t>(tree.size()), -1);
  mesh.install(std::move(tree), std::move(owners), fresh);
}

/// The same tree, every block on this rank: the answer that does not know of other ranks.
inline amr::Mesh whole_copy(const amr::Mesh& mesh) {
  amr::Mesh whole(mesh.shape(), mesh.fields(), MPI_COMM_SELF);
  put(whole, mesh.tree(), std::vector<int>(static_cast<std::size_t>(mesh.tree().size()), 0));
  return whole;
}

/// Calls f(cell) for the interior, or with the ghosts too.
template <class F>
void for_interior(const amr::Layout& layout, F&& f) {
  amr::for_each_cell(filled(0), filled(layout.n), f);
}
template <class F>
void for_all(const amr::Layout& layout, F&& f) {
  amr::for_each_cell(filled(-amr::Layout::GHOSTS), filled(layout.pitch()), f);
}
inline bool is_interior(const IntVec& cell, int n) {
  for (int c : cell)
    if (c < 0 || c >= n) return false;
  return true;
}

/// NaN wherever nobody writes: whoever reads it is found out.
inline void poison(amr::Mesh& mesh, amr::CellField field) {
  for (int b = 0; b < mesh.size(); ++b) {
    double* p = mesh.cells(field, b);
    for_all(mesh.layout(),
            [&](const IntVec& c) { p[mesh.layout().offset(c)] = std::numeric_limits<double>::quiet_NaN(); });
  }
}

/// Interior cells become value(block, cell), all ghosts NaN.
template <class Value>
void set_interior(amr::Mesh& mesh, amr::CellField field, Value&& value) {
  poison(mesh, field);
  for (int b = 0; b < mesh.size(); ++b) {
    double* p = mesh.cells(field, b);
    for_interior(mesh.layout(),
                 [&](const IntVec& c) { p[mesh.layout().offset(c)] = value(mesh.block(b), c); });
  }
}

inline void set_noise(amr::Mesh& mesh, amr::CellField field, int seed) {
  set_interior(mesh, field, [&](const amr::Block& block, const IntVec& c) {
    const int z = DIM == 3 ? c[DIM - 1] : 0, bz = DIM == 3 ? block.index.coord[DIM - 1] : 0;
    return noise(seed, block.index.level, block.index.coord[0], block.index.coord[1], bz, c[0], c[1], z);
  });
}

inline RealVec cell_centre(const amr::Block& block, const IntVec& cell) {
  RealVec x{};
  for (int a = 0; a < DIM; ++a) x[a] = block.lo[a] + (cell[a] + 0.5) * block.dx;
  return x;
}

/// A polynomial of degree two about `origin`, known by its means over cells.
struct Quadratic {
  double constant = 0;
  RealVec origin{};
  RealVec linear{};
  Array<RealVec> second{};  ///< coefficient of x_a x_b for b >= a

  double mean(RealVec x, double dx) const {
    for (int a = 0; a < DIM; ++a) x[a] -= origin[a];
    double v = constant;
    for (int a = 0; a < DIM; ++a) {
      v += linear[a] * x[a] + second[a][a] * (x[a] * x[a] + dx * dx / 12);
      for (int b = a + 1; b < DIM; ++b) v += second[a][b] * x[a] * x[b];
    }
    return v;
  }
};

/// What a cell of any level holds, worked out cell by cell from leaves that are all on this rank: equal
/// level, copy; finer leaves, mean of the children; coarser leaf, third-order prolongation from the means
/// around the parent; beyond a side, the field's rule.
class Oracle {
 public:
  Oracle(const amr::Mesh& whole, amr::CellField field) : mesh_(whole), field_(field) {}

  /// `cell` counts cells of `level` from the low corner of the domain.
  double value(int level, IntVec cell) const {
    const int n = mesh_.layout().n;
    for (int a = 0; a < DIM; ++a) {
      const int extent = (mesh_.shape().root_blocks[a] << level) * n;
      if (cell[a] >= 0 && cell[a] < extent) continue;
      if (mesh_.shape().periodic()[a]) {
        cell[a] = (cell[a] % extent + extent) % extent;
        continue;
      }
      const amr::SideRule rule = mesh_.fields().row(field_.id).sides[2 * a + (cell[a] < 0 ? 0 : 1)];
      IntVec mirror = cell;
      mirror[a] = cell[a] < 0 ? -1 - cell[a] : 2 * extent - 1 - cell[a];
      return rule.kind == amr::SideRule::Kind::even ? value(level, mirror) : rule.value;
    }
    amr::BlockIndex node{level, {}};
    IntVec local{};
    for (int a = 0; a < DIM; ++a) {
      node.coord[a] = cell[a] / n;
      local[a] = cell[a] % n;
    }
    const int leaf = locate(node);
    if (mesh_.tree().leaf(leaf) == node) {
      return mesh_.cells(field_, mesh_.local(leaf))[mesh_.layout().offset(local)];
    }
    return mesh_.tree().leaf(leaf).level > level ? mean_of_children(level, cell) : prolonged(level, cell);
  }

  /// The relation of a cell to the leaf that covers it: -1 coarser, 0 equal, 1 finer, 2 beyond a side.
  int relation(int level, IntVec cell) const {
    amr::BlockIndex node{level, {}};
    for (int a = 0; a < DIM; ++a) {
      const int extent = (mesh_.shape().root_blocks[a] << level) * mesh_.layout().n;
      if (mesh_.shape().periodic()[a]) cell[a] = (cell[a] % extent + extent) % extent;
      if (cell[a] < 0 || cell[a] >= extent) return 2;
      node.coord[a] = cell[a] / mesh_.layout().n;
    }
    return mesh_.tree().leaf(locate(node)).level - level;
  }

 private:
  int locate(const amr::BlockIndex& node) const {  // most questions follow one about the same block
    amr::BlockIndex& asked = asked_[static_cast<std::size_t>(node.level % 2)];
    int& answer = answer_[static_cast<std::size_t>(node.level % 2)];
    if (answer < 0 || node != asked) {
      asked = node;
      answer = mesh_.tree().locate(node);
    }
    return answer;
  }
  double mean_of_children(int level, const IntVec& cell) const {
    double sum = 0;
    for (int child = 0; child < CHILDREN; ++child) {
      IntVec fine{};
      for (int a = 0; a < DIM; ++a) fine[a] = 2 * cell[a] + (child >> a & 1);
      sum += value(level + 1, fine);
    }
    return sum / CHILDREN;
  }
  double prolonged(int level, const IntVec& cell) const {
    std::array<double, DIRECTIONS> around{};
    for (int dir = 0; dir < DIRECTIONS; ++dir) {
      IntVec coarse{};
      for (int a = 0; a < DIM; ++a) coarse[a] = (cell[a] >> 1) + direction_offset(dir)[a];
      around[static_cast<std::size_t>(dir)] = value(level - 1, coarse);
    }
    Array<double> side{};
    for (int a = 0; a < DIM; ++a) side[a] = (cell[a] & 1) != 0 ? 1 : -1;
    return amr::child_value(around.data() + CENTRE, amr::packed_ref(around.data(), filled(3)).stride, side);
  }

  const amr::Mesh& mesh_;
  amr::CellField field_;
  mutable std::array<amr::BlockIndex, 2> asked_;  // one for odd levels, one for even ones
  mutable std::array<int, 2> answer_{-1, -1};
};

/// Place of a block's cell in the numbering that Oracle uses.
inline IntVec global_cell(const amr::Block& block, const IntVec& cell, int n) {
  IntVec g{};
  for (int a = 0; a < DIM; ++a) g[a] = block.index.coord[a] * n + cell[a];
  return g;
}

}  // namespace dendrift::test

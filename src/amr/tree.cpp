#include "amr/tree.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace dendrift::amr {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

BlockIndex parent_of(const BlockIndex& b) {
  BlockIndex p{b.level - 1, b.coord};
  for (int& c : p.coord) c >>= 1;
  return p;
}

BlockIndex child_of(const BlockIndex& b, int child) {
  BlockIndex c{b.level + 1, b.coord};
  for (int a = 0; a < DIM; ++a) c.coord[a] = 2 * c.coord[a] + ((child >> a) & 1);
  return c;
}

bool is_first_child(const BlockIndex& b) {
  return std::all_of(b.coord.begin(), b.coord.end(), [](int c) { return (c & 1) == 0; });
}

void require_fit(const IntVec& root, int max_level) {
  if (max_level < 0 || max_level > 20) throw std::invalid_argument("tree: max_level must be 0 to 20");
  if (!Tree::fits(root, max_level))
    throw std::invalid_argument("tree: more than " + std::to_string(Tree::MOST_ALONG_AXIS) +
                                " blocks along an axis on the finest level");
}

std::vector<BlockIndex> root_leaves(const IntVec& root, int max_level) {
  require_fit(root, max_level);
  std::vector<BlockIndex> leaves;
  for (std::int64_t i = 0; i < volume(root); ++i) {
    BlockIndex b;
    std::int64_t rest = i;
    for (int a = 0; a < DIM; ++a) {
      b.coord[a] = static_cast<int>(rest % root[a]);
      rest /= root[a];
    }
    leaves.push_back(b);
  }
  return leaves;
}

}  // namespace

bool Tree::fits(const IntVec& root_blocks, int max_level) {
  return std::all_of(root_blocks.begin(), root_blocks.end(),
                     [&](int r) { return (std::int64_t{r} << max_level) <= MOST_ALONG_AXIS; });
}

Tree::Tree(IntVec root_blocks, Array<bool> periodic, int max_level)
    : Tree(root_blocks, periodic, max_level, root_leaves(root_blocks, max_level)) {}

Tree::Tree(IntVec root_blocks, Array<bool> periodic, int max_level, std::vector<BlockIndex> leaves)
    : root_blocks_(root_blocks), periodic_(periodic), max_level_(max_level), leaves_(std::move(leaves)) {
  require_fit(root_blocks_, max_level);
  for (const BlockIndex& b : leaves_) {
    BlockIndex inside_box = b;
    if (b.level < 0 || b.level > max_level_ || !inside(inside_box) || inside_box != b)
      throw std::invalid_argument("tree: leaf outside the domain");
  }
  if (leaves_.empty()) throw std::invalid_argument("tree: no leaves");
  index_leaves();
  validate();
}

std::uint64_t Tree::key(const BlockIndex& node) const {
  std::uint64_t k = 0;
  const int shift = max_level_ - node.level;
  for (int bit = 63 / DIM - 1; bit >= 0; --bit) {
    for (int a = DIM - 1; a >= 0; --a) {
      const std::uint64_t x = static_cast<std::uint64_t>(node.coord[a]) << shift;
      k = (k << 1) | ((x >> bit) & 1U);
    }
  }
  return k;
}

bool Tree::inside(BlockIndex& node) const {
  for (int a = 0; a < DIM; ++a) {
    const int extent = root_blocks_[a] << node.level;
    if (node.coord[a] >= 0 && node.coord[a] < extent) continue;
    if (!periodic_[a]) return false;
    node.coord[a] = ((node.coord[a] % extent) + extent) % extent;
  }
  return true;
}

int Tree::finest_level() const {
  int finest = 0;
  for (const BlockIndex& b : leaves_) finest = std::max(finest, b.level);
  return finest;
}

int Tree::locate(const BlockIndex& node) const {
  const std::uint64_t k = key(node);
  const auto above = std::upper_bound(keys_.begin(), keys_.end(), k);
  const int before = static_cast<int>(above - keys_.begin()) - 1;
  // A refined node starts with its first descendant, whose key is the node's own.
  return before;
}

int Tree::find(const BlockIndex& node) const {
  BlockIndex b = node;
  if (node.level > max_level_ || !inside(b) || b != node) return -1;
  const int i = locate(node);
  return i >= 0 && leaf(i) == node ? i : -1;
}

void Tree::index_leaves() {
  std::vector<std::pair<std::uint64_t, BlockIndex>> order;
  order.reserve(leaves_.size());
  for (const BlockIndex& b : leaves_) order.emplace_back(key(b), b);
  std::sort(order.begin(), order.end());
  keys_.resize(order.size());
  for (std::size_t i = 0; i < order.size(); ++i) {
    keys_[i] = order[i].first;
    leaves_[i] = order[i].second;
  }
  neighbours_.assign(leaves_.size() * DIRECTIONS, Neighbour{});
  for (int i = 0; i < size(); ++i) {
    for (int d = 0; d < DIRECTIONS; ++d) {
      BlockIndex node = leaf(i);
      const IntVec o = direction_offset(d);
      for (int a = 0; a < DIM; ++a) node.coord[a] += o[a];
      if (!inside(node)) continue;
      const int j = std::max(0, locate(node));  // a gap before the first leaf: validate() will refuse it
      Neighbour& n = neighbours_[at(i) * DIRECTIONS + at(d)];
      const int level = leaf(j).level;
      if (level > node.level) {
        n.kind = Neighbour::Kind::finer;
      } else {
        n.kind = level == node.level ? Neighbour::Kind::same : Neighbour::Kind::coarser;
        n.leaf = j;
      }
    }
  }
}

void Tree::validate() const {
  // Morton ranges that neither overlap nor leave gaps inside the domain <=> volumes add up and keys differ.
  double covered = 0;
  for (int i = 0; i < size(); ++i) {
    covered += std::ldexp(1.0, -DIM * leaf(i).level);
    if (i > 0 && keys_[at(i)] < keys_[at(i - 1)] + (std::uint64_t{1} << (DIM * (max_level_ - leaf(i - 1).level))))
      throw std::invalid_argument("tree: leaves overlap");
  }
  if (covered != static_cast<double>(volume(root_blocks_)))
    throw std::invalid_argument("tree: leaves do not cover the domain");
  for (int i = 0; i < size(); ++i) {
    for (int d = 0; d < DIRECTIONS; ++d) {
      const Neighbour n = neighbour(i, d);
      if (n.kind == Neighbour::Kind::coarser && leaf(n.leaf).level < leaf(i).level - 1)
        throw std::invalid_argument("tree: leaves are not 2:1 balanced");
    }
  }
}

void Tree::finer_neighbours(int i, int direction, std::vector<FinerNeighbour>& out) const {
  const IntVec o = direction_offset(direction);
  BlockIndex node = leaf(i);
  for (int a = 0; a < DIM; ++a) node.coord[a] += o[a];
  if (!inside(node)) return;
  for (int child = 0; child < CHILDREN; ++child) {
    FinerNeighbour f{-1, {}};
    bool touches = true;
    for (int a = 0; a < DIM; ++a) {
      f.child[a] = (child >> a) & 1;
      if (o[a] != 0 && f.child[a] != (o[a] < 0 ? 1 : 0)) touches = false;
    }
    if (!touches) continue;
    f.leaf = locate(child_of(node, child));
    out.push_back(f);
  }
}

std::vector<int> Tree::touching(int i) const {
  std::vector<int> out;
  std::vector<FinerNeighbour> finer;
  for (int d = 0; d < DIRECTIONS; ++d) {
    if (d == CENTRE) continue;
    const Neighbour n = neighbour(i, d);
    if (n.kind == Neighbour::Kind::finer) {
      finer.clear();
      finer_neighbours(i, d, finer);
      for (const FinerNeighbour& f : finer) out.push_back(f.leaf);
    } else if (n.leaf >= 0) {
      out.push_back(n.leaf);
    }
  }
  std::sort(out.begin(), out.end());
  out.erase(std::unique(out.begin(), out.end()), out.end());
  return out;
}

std::vector<std::int8_t> Tree::balanced(std::span<const std::int8_t> change) const {
  std::vector<std::int8_t> c(change.begin(), change.end());
  for (int i = 0; i < size(); ++i) {
    if (leaf(i).level == max_level_) c[at(i)] = std::min<std::int8_t>(c[at(i)], 0);
    if (leaf(i).level == 0) c[at(i)] = std::max<std::int8_t>(c[at(i)], 0);
  }
  // A family is complete when its members follow each other as leaves of one level.
  auto cancel_lone_coarsening = [&] {
    bool changed = false;
    for (int i = 0; i < size(); ++i) {
      if (c[at(i)] >= 0) continue;
      const BlockIndex parent = parent_of(leaf(i));
      const int first = locate(child_of(parent, 0));
      bool family = first + CHILDREN <= size();
      for (int m = 0; family && m < CHILDREN; ++m)
        family = leaf(first + m) == child_of(parent, m) && c[at(first + m)] < 0;
      if (!family) {
        c[at(i)] = 0;
        changed = true;
      }
    }
    return changed;
  };
  auto raise = [&](int from, int to, std::vector<int>& queue) {
    const int wanted = leaf(from).level + c[at(from)] - 1;
    if (leaf(to).level + c[at(to)] >= wanted) return;
    c[at(to)] = static_cast<std::int8_t>(wanted - leaf(to).level);
    queue.push_back(to);
  };
  std::vector<int> queue;
  std::vector<FinerNeighbour> finer;
  for (int i = 0; i < size(); ++i) queue.push_back(i);
  do {
    while (!queue.empty()) {
      const int i = queue.back();
      queue.pop_back();
      for (int d = 0; d < DIRECTIONS; ++d) {
        const Neighbour n = neighbour(i, d);
        if (n.leaf >= 0) {
          raise(i, n.leaf, queue);
        } else if (n.kind == Neighbour::Kind::finer) {
          finer.clear();
          finer_neighbours(i, d, finer);
          for (const FinerNeighbour& f : finer) raise(i, f.leaf, queue);
        }
      }
    }
    if (!cancel_lone_coarsening()) break;
    for (int i = 0; i < size(); ++i) queue.push_back(i);
  } while (true);
  return c;
}

Tree Tree::adapted(std::span<const std::int8_t> change) const {
  const std::vector<std::int8_t> c = balanced(change);
  std::vector<BlockIndex> next;
  next.reserve(leaves_.size());
  for (int i = 0; i < size(); ++i) {
    const BlockIndex& b = leaf(i);
    if (c[at(i)] == 0) {
      next.push_back(b);
    } else if (c[at(i)] > 0) {
      for (int m = 0; m < CHILDREN; ++m) next.push_back(child_of(b, m));
    } else if (is_first_child(b)) {
      next.push_back(parent_of(b));
    }
  }
  Tree t(*this);
  t.leaves_ = std::move(next);
  t.index_leaves();
  return t;
}

}  // namespace dendrift::amr

#include "amr/hierarchy.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <unordered_map>

#include "amr/face_transfer.hpp"

namespace dendrift::amr {

namespace {

constexpr int TAG = 120;
constexpr int G = Layout::GHOSTS;
constexpr int COARSEST_CELLS = 2;  // of a node along an axis
constexpr std::int64_t DIRECT_CELLS = DIM == 2 ? 1024 : 512;  // that the last grid may have

std::size_t at(int i) { return static_cast<std::size_t>(i); }

BlockIndex parent_of(BlockIndex b) {
  --b.level;
  for (int& c : b.coord) c >>= 1;
  return b;
}

std::uint64_t key(const IntVec& coord) {
  std::uint64_t k = 0;
  for (const int c : coord) k = (k << 21) | static_cast<std::uint64_t>(c);
  return k;
}

int face_of(int axis, bool high) { return 2 * axis + (high ? 1 : 0); }

int towards(int axis, int step) {
  IntVec o{};
  o[axis] = step;
  return direction_index(o);
}

std::int64_t cells_of(const Grid& g) { return volume(g.extent) * volume(filled(g.layout.n)); }

// A node beside a coarser leaf, and that leaf: parents never are, or levels would differ by two.
const Grid::Node& leaf_beyond(const Grid::Node& n, int face, const Grid& coarse) {
  return coarse.nodes[at(coarse.nodes[at(n.parent)].neighbours[at(direction_index(face_offset(face)))])];
}

// Adds the linear interpolation of a coarse array to a fine one: a line of coarse values for every fine row, weighted
// 3:1 across rows of cells and 1:1 between planes of faces, then the same along the row.
void add_linear(const ArrayRef<double>& x, const ArrayRef<const double>& coarse, const Range& box, int normal, int n) {
  std::array<double, 64> line_array{};
  double* line = line_array.data() + 2;  // coarse cells -1 to n/2 + 1
  const int half = n / 2;
  for_each_row(box.size, [&](const IntVec& row) {
    constexpr int CORNERS = CHILDREN / 2;
    std::array<double, CORNERS> weight{};
    std::array<const double*, CORNERS> from{};
    for (int corner = 0; corner < CORNERS; ++corner) {
      double w = 1;
      const double* p = coarse.p;
      for (int a = 1; a < DIM; ++a) {
        const int fine = box.lo[a] + row[a], odd = fine & 1;
        const bool far = (corner >> (a - 1) & 1) != 0;
        int place = fine >> 1;
        if (a == normal) {
          w *= odd != 0 ? 0.5 : far ? 0.0 : 1.0;
          if (far && odd != 0) ++place;
        } else {
          w *= far ? 0.25 : 0.75;
          if (far) place += odd != 0 ? 1 : -1;
        }
        p += place * coarse.stride[a];
      }
      weight[static_cast<std::size_t>(corner)] = w;
      from[static_cast<std::size_t>(corner)] = p;
    }
    for (int i = -1; i <= half; ++i) {
      double sum = 0;
      for (std::size_t corner = 0; corner < CORNERS; ++corner) sum += weight[corner] * from[corner][i];
      line[i] = sum;
    }
    IntVec start = row;
    for (int a = 0; a < DIM; ++a) start[a] += box.lo[a];
    start[0] = 0;
    double* out = x.at(start);
    const int last = box.lo[0] + box.size[0] - 1;
    if (normal == 0) {
      for (int i = 0; i < half; ++i) {
        if (2 * i >= box.lo[0]) out[2 * i] += line[i];
        out[2 * i + 1] += 0.5 * (line[i] + line[i + 1]);
      }
      if (last == n) out[n] += line[half];
    } else {
      for (int i = 0; i < half; ++i) {
        out[2 * i] += 0.75 * line[i] + 0.25 * line[i - 1];
        out[2 * i + 1] += 0.75 * line[i] + 0.25 * line[i + 1];
      }
    }
  });
}

// dst, a quadrant of coarse faces, = means of the fine ones over both sides of their planes (1:2:1), side by side
// along them.
void take_weighted(const ArrayRef<double>& dst, const ArrayRef<const double>& x, int normal, int n) {
  std::array<double, 64> line_array{};
  double* line = line_array.data() + 1;  // fine places -1 to n - 1
  constexpr int MOST = 3;
  struct Share {
    int count;
    std::array<int, MOST> place;
    std::array<double, MOST> weight;
  };
  const auto shares = [](bool across, int coarse) {
    return across ? Share{2, {2 * coarse, 2 * coarse + 1}, {0.5, 0.5}}
                  : Share{3, {2 * coarse - 1, 2 * coarse, 2 * coarse + 1}, {0.25, 0.5, 0.25}};
  };
  for_each_row(filled(n / 2), [&](const IntVec& row) {
    std::fill_n(line - 1, n + 1, 0.0);
    const auto add = [&](const double* from, double weight) {
      for (int i = -1; i < n; ++i) line[i] += weight * from[i];
    };
    const Share y = shares(normal != 1, row[1]);
    for (std::size_t j = 0; j < at(y.count); ++j) {
      const double* p = x.p + y.place[j] * x.stride[1];
      if constexpr (DIM == 2) {
        add(p, y.weight[j]);
      } else {
        const Share z = shares(normal != 2, row[2]);
        for (std::size_t k = 0; k < at(z.count); ++k) add(p + z.place[k] * x.stride[2], y.weight[j] * z.weight[k]);
      }
    }
    double* out = dst.at(row);
    for (int i = 0; i < n / 2; ++i) {
      const double* f = line + 2 * i;
      out[i] = normal == 0 ? 0.25 * (f[-1] + f[1]) + 0.5 * f[0] : 0.5 * (f[0] + f[1]);
    }
  });
}

}  // namespace

HierarchyField::HierarchyField(const Hierarchy& h, std::vector<Component> components) : components_(std::move(components)) {
  for (int g = 0; g < h.grids(); ++g) {
    const Layout& layout = h.grid(g).layout;
    layouts_.push_back(layout);
    size_.push_back(layout.size());
    origin_.push_back(layout.interior());
    data_.emplace_back(static_cast<std::size_t>(layout.size()) * components_.size() * h.grid(g).local.size(), 0.0);
  }
}

ArrayRef<double> HierarchyField::ref(int g, int i, int c) { return array_ref(at(g, i, c), layouts_[static_cast<std::size_t>(g)]); }
ArrayRef<const double> HierarchyField::ref(int g, int i, int c) const { return array_ref(at(g, i, c), layouts_[static_cast<std::size_t>(g)]); }

void HierarchyField::clear(int g) {
  std::vector<double>& d = data_[static_cast<std::size_t>(g)];
  std::fill(d.begin(), d.end(), 0.0);
}

Hierarchy::Hierarchy(const Mesh& mesh) : mesh_(mesh), rank_(mesh.rank()) {
  add_level_grids();
  for (int g = 0; g < levels_; ++g)
    if (std::ranges::any_of(grid(g).nodes, [](const Grid::Node& n) { return n.leaf >= 0; })) coarsest_leaf_ = g;
  if (!end_at_level()) add_grids_beneath();
  routes_.resize(grids_.size());
  for (int g = 0; g < grids(); ++g) connect(g);
  for (int g = 0; g < grids(); ++g) build_routes(g);
  places_.resize(at(mesh.size()));
  for (int g = 0; g < levels_; ++g)
    for (int i = 0; i < grid(g).size(); ++i)
      if (grid(g).mine(i).leaf >= 0) places_[at(mesh.local(grid(g).mine(i).leaf))] = {g, i};
}

// Leaves come along the Morton curve, so a parent's first leaf is met first and nodes of a level stay in order.
void Hierarchy::add_level_grids() {
  const Tree& tree = mesh_.tree();
  levels_ = tree.finest_level() + 1;
  grids_.resize(at(levels_));
  const auto of_level = [&](int level) -> Grid& { return grids_[at(levels_ - 1 - level)]; };
  for (int l = 0; l < levels_; ++l) {
    of_level(l).layout = mesh_.layout();
    of_level(l).dx = mesh_.shape().dx(l);
    of_level(l).extent = mesh_.shape().root_blocks;
    for (int& e : of_level(l).extent) e <<= l;
  }
  for (int leaf = 0; leaf < tree.size(); ++leaf) {
    Grid::Node n;
    n.index = tree.leaf(leaf);
    n.owner = mesh_.owner(leaf);
    n.leaf = leaf;
    while (true) {
      std::vector<Grid::Node>& nodes = of_level(n.index.level).nodes;
      if (!nodes.empty() && nodes.back().index == n.index) break;
      nodes.push_back(n);
      if (n.index.level == 0) break;
      n.index = parent_of(n.index);
      n.leaf = -1;
    }
  }
  const int half = mesh_.layout().n / 2;
  for (int l = 1; l < levels_; ++l) {
    int p = 0;
    for (Grid::Node& n : of_level(l).nodes) {
      const BlockIndex parent = parent_of(n.index);
      while (of_level(l - 1).nodes[at(p)].index != parent) ++p;
      n.parent = p;
      for (int a = 0; a < DIM; ++a) n.place[a] = (n.index.coord[a] & 1) * half;
    }
  }
}

// Ends the ladder at the first level beneath all leaves that has few enough cells. False: there is none.
bool Hierarchy::end_at_level() {
  for (int g = coarsest_leaf_ + 1; g < levels_; ++g) {
    if (cells_of(grid(g)) > DIRECT_CELLS) continue;
    levels_ = g + 1;
    grids_.resize(at(levels_));
    for (Grid::Node& n : grids_.back().nodes) {
      n.owner = 0;
      n.parent = -1;
    }
    return true;
  }
  return false;
}

// So few cells that one rank solves them faster alone than all by messages: roots of fewer and fewer cells, then groups
// of roots as if the tree went on. Not further than a direct solution asks for: solids that the last grids do not resolve
// cost iterations, the more the stiffer they are.
void Hierarchy::add_grids_beneath() {
  const auto halved = [](Grid g) {
    for (Grid::Node& n : g.nodes) {
      n.leaf = n.parent = -1;
      n.owner = 0;
      n.place = {};
    }
    g.dx *= 2;
    return g;
  };
  while (grids_.back().layout.n / 2 >= COARSEST_CELLS && (grids() == levels_ || cells_of(grids_.back()) > DIRECT_CELLS)) {
    Grid g = halved(grids_.back());
    for (std::size_t i = 0; i < g.nodes.size(); ++i) grids_.back().nodes[i].parent = static_cast<int>(i);
    g.layout.n /= 2;
    grids_.push_back(std::move(g));
  }
  const auto even = [](int e) { return e % 2 == 0; };
  while (cells_of(grids_.back()) > DIRECT_CELLS && std::ranges::all_of(grids_.back().extent, even)) {
    Grid& fine = grids_.back();
    Grid g = halved(fine);
    g.nodes.clear();
    std::unordered_map<std::uint64_t, int> number;
    for (Grid::Node& n : fine.nodes) {
      Grid::Node group;
      for (int a = 0; a < DIM; ++a) {
        group.index.coord[a] = n.index.coord[a] / 2;
        n.place[a] = n.index.coord[a] % 2 * (fine.layout.n / 2);
      }
      const auto [found, is_new] = number.emplace(key(group.index.coord), static_cast<int>(g.nodes.size()));
      n.parent = found->second;
      if (is_new) g.nodes.push_back(group);
    }
    for (int& e : g.extent) e /= 2;
    grids_.push_back(std::move(g));
  }
}

void Hierarchy::connect(int g) {
  Grid& grid = grids_[at(g)];
  const IntVec& extent = grid.extent;
  const Array<bool> periodic = mesh_.shape().periodic();
  std::unordered_map<std::uint64_t, int> number;
  number.reserve(grid.nodes.size());
  for (std::size_t i = 0; i < grid.nodes.size(); ++i) number[key(grid.nodes[i].index.coord)] = static_cast<int>(i);
  for (std::size_t i = 0; i < grid.nodes.size(); ++i) {
    Grid::Node& n = grid.nodes[i];
    if (n.owner == rank_) {
      n.local = static_cast<int>(grid.local.size());
      grid.local.push_back(static_cast<int>(i));
    }
    for (int d = 0; d < DIRECTIONS; ++d) {
      const IntVec o = direction_offset(d);
      IntVec c = n.index.coord;
      bool inside = true;
      for (int a = 0; a < DIM; ++a) {
        c[a] += o[a];
        if (c[a] >= 0 && c[a] < extent[a]) continue;
        if (periodic[a]) {
          c[a] = (c[a] + extent[a]) % extent[a];
        } else {
          inside = false;
        }
      }
      int& to = n.neighbours[at(d)];
      to = Grid::OUTSIDE;
      if (!inside) continue;
      const auto found = number.find(key(c));
      to = found == number.end() ? Grid::COARSER : found->second;
    }
  }
}

// lists(emit): calls emit(dst_node, dst_owner, src_node, src_owner, tag, order) for every transfer that concerns this
// rank, with local node numbers where they are ours.
template <class Lists>
Hierarchy::Route Hierarchy::make_route(Lists&& lists) {
  Route route;
  std::map<int, Message> by_rank;
  lists([&](const Item& item, int dst_owner, int src_owner) {
    if (dst_owner == rank_ && src_owner == rank_) {
      route.local.push_back(item);
    } else if (dst_owner == rank_) {
      by_rank[src_owner].recv.push_back(item);
    } else if (src_owner == rank_) {
      by_rank[dst_owner].send.push_back(item);
    }
  });
  for (auto& [rank, m] : by_rank) {
    m.rank = rank;
    const auto before = [](const Item& a, const Item& b) { return a.order < b.order; };
    std::sort(m.send.begin(), m.send.end(), before);
    std::sort(m.recv.begin(), m.recv.end(), before);
    route.messages.push_back(std::move(m));
  }
  return route;
}

void Hierarchy::build_routes(int g) {
  const Grid& grid = grids_[at(g)];
  Routes& r = routes_[at(g)];
  r.same = make_route([&](auto&& emit) {
    for (std::size_t i = 0; i < grid.nodes.size(); ++i)
      for (int d = 0; d < DIRECTIONS; ++d) {
        const int from = grid.nodes[i].neighbours[at(d)];
        if (d == CENTRE || from < 0) continue;
        const Grid::Node &to_node = grid.nodes[i], &from_node = grid.nodes[at(from)];
        if (to_node.owner != rank_ && from_node.owner != rank_) continue;
        // The tag names the destination as well: its surroundings decide how much is copied.
        emit(Item{static_cast<int>(i), from_node.local, d, static_cast<int>(i) * DIRECTIONS + d, ghost_boxes(grid, to_node, d)},
             to_node.owner, from_node.owner);
      }
  });
  if (g + 1 == grids()) return;
  const Grid& coarse = grids_[at(g + 1)];
  r.from_parent = make_route([&](auto&& emit) {
    for (std::size_t i = 0; i < grid.nodes.size(); ++i) {
      const Grid::Node &n = grid.nodes[i], &p = coarse.nodes[at(n.parent)];
      emit(Item{static_cast<int>(i), p.local, 0, static_cast<int>(i), {}}, n.owner, p.owner);
    }
  });
  r.ghosts_from_parent = make_route([&](auto&& emit) {
    for (std::size_t i = 0; i < grid.nodes.size(); ++i) {
      const Grid::Node &n = grid.nodes[i], &p = coarse.nodes[at(n.parent)];
      if (std::find(n.neighbours.begin(), n.neighbours.end(), Grid::COARSER) == n.neighbours.end()) continue;
      emit(Item{static_cast<int>(i), p.local, 0, static_cast<int>(i), {}}, n.owner, p.owner);
    }
  });
  r.to_parent = make_route([&](auto&& emit) {
    for (std::size_t i = 0; i < grid.nodes.size(); ++i) {
      const Grid::Node &n = grid.nodes[i], &p = coarse.nodes[at(n.parent)];
      emit(Item{p.local, static_cast<int>(i), 0, static_cast<int>(i), {}}, p.owner, n.owner);
    }
  });
  // The high faces of a node that has a coarser leaf beyond are the low faces of that leaf; at a side of the box they are
  // the high faces of its parent.
  r.to_plane = make_route([&](auto&& emit) {
    for (std::size_t i = 0; i < grid.nodes.size(); ++i)
      for (int a = 0; a < DIM; ++a) {
        const Grid::Node& n = grid.nodes[i];
        const int above = n.neighbours[at(towards(a, 1))];
        if (above >= 0) continue;
        const int owner = above == Grid::OUTSIDE ? n.parent : coarse.nodes[at(n.parent)].neighbours[at(towards(a, 1))];
        const Grid::Node& q = coarse.nodes[at(owner)];
        emit(Item{q.local, static_cast<int>(i), a, static_cast<int>(i) * DIM + a, {}}, q.owner, n.owner);
      }
  });
  r.to_border = make_route([&](auto&& emit) {
    for (std::size_t i = 0; i < grid.nodes.size(); ++i)
      for (int f = 0; f < FACES; ++f) {
        const Grid::Node& n = grid.nodes[i];
        if (g + 1 >= levels_ || n.neighbours[at(direction_index(face_offset(f)))] != Grid::COARSER) continue;
        const Grid::Node& q = leaf_beyond(n, f, coarse);
        emit(Item{q.local, static_cast<int>(i), f, static_cast<int>(i) * FACES + f, {}}, q.owner, n.owner);
      }
  });
}

template <class Size, class Pack, class Unpack, class Direct>
void Hierarchy::run(Route& r, Size&& size, Pack&& pack, Unpack&& unpack, Direct&& direct) {
  std::vector<MPI_Request> requests;
  requests.reserve(2 * r.messages.size());
  for (Message& m : r.messages) {
    std::ptrdiff_t total = 0;
    for (const Item& item : m.recv) total += size(item);
    m.recv_buffer.resize(static_cast<std::size_t>(total));
    if (total > 0)
      MPI_Irecv(m.recv_buffer.data(), static_cast<int>(total), MPI_DOUBLE, m.rank, TAG, mesh_.comm(), &requests.emplace_back());
  }
  for (Message& m : r.messages) {
    std::ptrdiff_t total = 0;
    for (const Item& item : m.send) total += size(item);
    m.send_buffer.resize(static_cast<std::size_t>(total));
    double* p = m.send_buffer.data();
    for (const Item& item : m.send) {
      pack(item, p);
      p += size(item);
    }
    if (total > 0)
      MPI_Isend(m.send_buffer.data(), static_cast<int>(total), MPI_DOUBLE, m.rank, TAG, mesh_.comm(), &requests.emplace_back());
  }
  // Small and alike: handing them out one by one would cost as much as they do.
  const std::ptrdiff_t count = static_cast<std::ptrdiff_t>(r.local.size());
#pragma omp parallel for schedule(static) if (count > 1)
  for (std::ptrdiff_t i = 0; i < count; ++i) direct(r.local[static_cast<std::size_t>(i)]);
  MPI_Waitall(static_cast<int>(requests.size()), requests.data(), MPI_STATUSES_IGNORE);
  for (Message& m : r.messages) {
    const double* p = m.recv_buffer.data();
    for (const Item& item : m.recv) {
      unpack(item, p);
      p += size(item);
    }
  }
}

Range Hierarchy::unknowns(int g, int i, const Component& c, bool composite) const {
  const Grid& gr = grid(g);
  const Grid::Node& n = gr.mine(i);
  Range r{{}, filled(gr.layout.n)};
  if (c.normal < 0) return r;
  const int a = c.normal;
  const int below = n.neighbours[at(towards(a, -1))], above = n.neighbours[at(towards(a, 1))];
  int first = 0, last = gr.layout.n - 1;
  if (below == Grid::OUTSIDE && c.sides[at(face_of(a, false))].odd) first = 1;
  if (composite && below >= 0 && gr.nodes[at(below)].leaf < 0) first = 1;
  if (above == Grid::COARSER || (above == Grid::OUTSIDE && !c.sides[at(face_of(a, true))].odd)) last = gr.layout.n;
  r.lo[a] = first;
  r.size[a] = last - first + 1;
  return r;
}

// Ghosts of a node in one direction. A plane of faces on the far side of the box belongs to it unless another node
// of this grid lies there and owns it; so does the plane between the box and a coarser leaf over it.
Range Hierarchy::ghost_box(const Grid& grid, const Grid::Node& n, int direction, int normal, int depth) const {
  const IntVec o = direction_offset(direction);
  const int cells = grid.layout.n;
  Range r;
  for (int a = 0; a < DIM; ++a) {
    r.lo[a] = o[a] < 0 ? -depth : o[a] > 0 ? cells : 0;
    r.size[a] = o[a] == 0 ? cells : depth;
    if (a != normal) continue;
    IntVec above = o;
    ++above[a];
    if (o[a] <= 0) {
      if (n.neighbours[at(direction_index(above))] < 0) ++r.size[a];
    } else if (depth == 1) {
      r.size[a] = 2;  // the plane at the side, and the first beyond it
    }
  }
  return r;
}

Hierarchy::GhostBoxes Hierarchy::ghost_boxes(const Grid& grid, const Grid::Node& n, int direction) const {
  GhostBoxes boxes;
  const IntVec o = direction_offset(direction);
  for (int normal = -1; normal < DIM; ++normal)
    for (int depth = 1; depth <= G; ++depth) {
      const Range r = ghost_box(grid, n, direction, normal, depth);
      IntVec from = r.lo;
      for (int a = 0; a < DIM; ++a) from[a] -= o[a] * grid.layout.n;
      boxes.of[at((normal + 1) * G + depth - 1)] = {grid.layout.offset(r.lo), grid.layout.offset(from), r.size};
    }
  return boxes;
}

void Hierarchy::exchange(HierarchyField& f, int g, int depth, bool homogeneous) {
  const Grid& gr = grid(g);
  const Layout& layout = gr.layout;
  const int nc = f.components();
  const auto box = [&](const Item& item, int c) -> const GhostCopy& { return item.boxes.at(f.component(c).normal, depth); };
  run(
      routes_[at(g)].same,
      [&](const Item& item) {
        std::ptrdiff_t total = 0;
        for (int c = 0; c < nc; ++c) total += volume(box(item, c).size);
        return total;
      },
      [&](const Item& item, double* p) {
        for (int c = 0; c < nc; ++c) {
          const GhostCopy& k = box(item, c);
          const double* src = f.at(g, item.src, c) + k.src;
          for_each_row(k.size, [&](const IntVec& row) { p = std::copy_n(src + layout.offset(row), k.size[0], p); });
        }
      },
      [&](const Item& item, const double* p) {
        for (int c = 0; c < nc; ++c) {
          const GhostCopy& k = box(item, c);
          double* dst = f.at(g, gr.nodes[at(item.dst)].local, c) + k.dst;
          for_each_row(k.size, [&](const IntVec& row) {
            std::copy_n(p, k.size[0], dst + layout.offset(row));
            p += k.size[0];
          });
        }
      },
      [&](const Item& item) {
        for (int c = 0; c < nc; ++c) {
          const GhostCopy& k = box(item, c);
          double* dst = f.at(g, gr.nodes[at(item.dst)].local, c) + k.dst;
          const double* src = f.at(g, item.src, c) + k.src;
          if (k.size[0] == 2) {  // columns: no loop along x
            for_each_row(k.size, [&](const IntVec& row) {
              const std::ptrdiff_t o = layout.offset(row);
              const double first = src[o], second = src[o + 1];
              dst[o] = first;
              dst[o + 1] = second;
            });
            continue;
          }
          for_each_row(k.size, [&](const IntVec& row) {
            const std::ptrdiff_t o = layout.offset(row);
            for (int i = 0; i < k.size[0]; ++i) dst[o + i] = src[o + i];
          });
        }
      });
  parallel_for(gr.size(), [&](int i) { apply_sides(f, g, i, depth, homogeneous); });
}

// Axis by axis over all rows, ghosts included, so that edges and corners follow from what is there.
void Hierarchy::apply_sides(HierarchyField& f, int g, int i, int depth, bool homogeneous) const {
  const Grid& gr = grid(g);
  const Grid::Node& n = gr.mine(i);
  const int cells = gr.layout.n;
  for (int axis = 0; axis < DIM; ++axis)
    for (const bool high : {false, true}) {
      if (n.neighbours[at(towards(axis, high ? 1 : -1))] != Grid::OUTSIDE) continue;
      for (int c = 0; c < f.components(); ++c) {
        const Component& component = f.component(c);
        const MirrorRule& rule = component.sides[at(face_of(axis, high))];
        const double constant = homogeneous ? 0.0 : rule.value.constant;
        const bool varies = !homogeneous && !rule.value.uniform();  // on levels of the tree only
        const auto value = [&](const IntVec& q) {
          if (!varies) return constant;
          RealVec place{};
          for (int a = 0; a < DIM; ++a) {
            const double start = mesh_.shape().lo[a] + gr.dx * n.index.coord[a] * cells;
            place[a] = start + gr.dx * (a == axis ? (high ? cells : 0) : a == component.normal ? q[a] : q[a] + 0.5);
          }
          return rule.value.at(place, gr.dx);
        };
        const ArrayRef<double> x = f.ref(g, i, c);
        IntVec lo = filled(-G), size = filled(cells + 2 * G);
        size[axis] = 1;
        const auto plane = [&](int to, int from) {
          IntVec at_to = lo;
          at_to[axis] = to;
          const std::ptrdiff_t back = (from - to) * x.stride[axis];
          for_each_cell(at_to, size, [&](const IntVec& q) {
            double* p = x.at(q);
            *p = rule.odd ? 2 * value(q) - p[back] : p[back];
          });
        };
        if (component.normal == axis) {
          const int side = high ? cells : 0;
          if (rule.odd) {
            IntVec at_side = lo;
            at_side[axis] = side;
            for_each_cell(at_side, size, [&](const IntVec& q) { *x.at(q) = value(q); });
          }
          for (int k = 1; k <= (high ? 1 : depth); ++k) plane(high ? side + k : side - k, high ? side - k : side + k);
        } else {
          for (int k = 0; k < depth; ++k) plane(high ? cells + k : -1 - k, high ? cells - 1 - k : k);
        }
      }
    }
}

// use(local node, parents): parents[c] is the array of the parent, shifted so that its cell 0 holds the node's.
template <class F>
void Hierarchy::with_parents(const HierarchyField& f, int g, Route& route, F&& use) {
  const Grid& gr = grid(g);
  const int nc = f.components();
  const IntVec size = filled(gr.layout.n / 2 + 2 * G);
  const auto patch = [&](int src, const Grid::Node& n, int c) {
    ArrayRef<const double> r = f.ref(g + 1, src, c);
    r.p = r.at(n.place);
    return r;
  };
  run(
      route, [&](const Item&) { return nc * volume(size); },
      [&](const Item& item, double* p) {
        for (int c = 0; c < nc; ++c, p += volume(size))
          copy_box(packed_ref(p, size), {}, patch(item.src, gr.nodes[at(item.dst)], c), filled(-G), size);
      },
      [&](const Item& item, const double* p) {
        Parents parents{};
        for (int c = 0; c < nc; ++c) {
          parents[at(c)] = packed_ref(p + c * volume(size), size);
          parents[at(c)].p = parents[at(c)].at(filled(G));
        }
        use(gr.nodes[at(item.dst)].local, parents);
      },
      [&](const Item& item) {
        Parents parents{};
        for (int c = 0; c < nc; ++c) parents[at(c)] = patch(item.src, gr.nodes[at(item.dst)], c);
        use(gr.nodes[at(item.dst)].local, parents);
      });
}

void Hierarchy::fill_coarse_ghosts(HierarchyField& f, int g, int i, const Parents& parents, bool add) const {
  const Grid& gr = grid(g);
  const Grid::Node& n = gr.mine(i);
  for (int d = 0; d < DIRECTIONS; ++d) {
    if (n.neighbours[at(d)] != Grid::COARSER) continue;
    const IntVec o = direction_offset(d);
    for (int c = 0; c < f.components(); ++c) {
      const int a = f.component(c).normal;
      Range r;
      for (int b = 0; b < DIM; ++b) {
        r.lo[b] = o[b] < 0 ? -G : o[b] > 0 ? gr.layout.n : 0;
        r.size[b] = o[b] == 0 ? gr.layout.n : G;
      }
      if (a >= 0) {
        IntVec above = o, below = o;
        ++above[a];
        --below[a];
        if (o[a] == 0 && n.neighbours[at(direction_index(above))] == Grid::OUTSIDE) ++r.size[a];
        if (o[a] >= 0 && n.neighbours[at(direction_index(below))] >= 0) {  // its last plane
          ++r.lo[a];
          --r.size[a];
        }
      }
      const ArrayRef<double> x = f.ref(g, i, c);
      for_each_cell(r.lo, r.size, [&](const IntVec& q) {
        const double value = fine_value(parents[at(c)], q, a, gr.layout.n);
        double& ghost = *x.at(q);
        ghost = add ? ghost + value : value;
      });
    }
  }
}

void Hierarchy::fill_from_coarser(const HierarchyField& coarse, HierarchyField& f, int g) {
  if (g + 1 >= levels_) return;
  with_parents(coarse, g, routes_[at(g)].ghosts_from_parent,
               [&](int i, const Parents& parents) { fill_coarse_ghosts(f, g, i, parents, false); });
}

void Hierarchy::prolong_add(HierarchyField& f, int g) {
  with_parents(f, g, routes_[at(g)].from_parent, [&](int i, const Parents& parents) {
    for (int c = 0; c < f.components(); ++c)
      add_linear(f.ref(g, i, c), parents[at(c)], unknowns(g, i, f.component(c), false), f.component(c).normal, grid(g).layout.n);
    fill_coarse_ghosts(f, g, i, parents, true);
  });
}

void Hierarchy::prolong_add_shared(HierarchyField& f, const HierarchyField& shares, int g) {
  const int n = grid(g).layout.n;
  with_parents(f, g, routes_[at(g)].from_parent, [&](int i, const Parents& parents) {
    const ArrayRef<double> x = f.ref(g, i, 0);
    const ArrayRef<const double>& coarse = parents[0];
    for_each_row(filled(n), [&](const IntVec& row) {
      IntVec above = row;
      for (int a = 1; a < DIM; ++a) above[a] = row[a] >> 1;
      above[0] = 0;
      const double* c = coarse.at(above);
      Array<std::ptrdiff_t> to{};
      for (int a = 1; a < DIM; ++a) to[a] = (row[a] & 1) != 0 ? coarse.stride[a] : -coarse.stride[a];
      double* out = x.at(row);
      Array<const double*> w{};
      for (int a = 0; a < DIM; ++a) w[a] = shares.ref(g, i, a).at(row);
      const auto along_y = [&](const double* p, int k) { return p[0] + w[1][k] * (p[to[1]] - p[0]); };
      const auto across = [&](const double* p, int k) {
        double v = along_y(p, k);
        if constexpr (DIM == 3) v += w[2][k] * (along_y(p + to[2], k) - v);
        return v;
      };
      const auto both = [&](int k, int towards_x) {
        const double* p = c + (k >> 1);
        const double own = across(p, k);
        return own + w[0][k] * (across(p + towards_x, k) - own);
      };
      for (int k = 0; k < n; k += 2) {
        out[k] += both(k, -1);
        out[k + 1] += both(k + 1, 1);
      }
    });
    fill_coarse_ghosts(f, g, i, parents, true);
  });
}

// value(array, place in the finer grid, normal, below, above): what a coarse cell or face receives from the fine ones
// that start at that place.
template <class Value>
void Hierarchy::restrict_by(const HierarchyField& from, HierarchyField& to, int g, Value&& value) {
  const Grid& gr = grid(g);
  const int nc = from.components(), half = gr.layout.n / 2;
  const IntVec size = filled(half);
  const auto quadrant = [&](int i, const ArrayRef<double>& dst, const IntVec& lo, int c) {
    const ArrayRef<const double> x = from.ref(g, i, c);
    const int a = from.component(c).normal;
    const bool open_below = a >= 0 && gr.mine(i).neighbours[at(towards(a, -1))] < 0;
    for_each_cell({}, size, [&](const IntVec& q) {
      IntVec fine{}, coarse{};
      for (int b = 0; b < DIM; ++b) {
        fine[b] = 2 * q[b];
        coarse[b] = lo[b] + q[b];
      }
      *dst.at(coarse) = value(x.at(fine), x.stride, a, open_below && q[std::max(a, 0)] == 0, false);
    });
  };
  const auto local = [&](int node) { return gr.nodes[at(node)].local; };
  run(
      routes_[at(g)].to_parent, [&](const Item&) { return nc * volume(size); },
      [&](const Item& item, double* p) {
        for (int c = 0; c < nc; ++c, p += volume(size)) quadrant(local(item.src), packed_ref(p, size), {}, c);
      },
      [&](const Item& item, const double* p) {
        for (int c = 0; c < nc; ++c, p += volume(size))
          copy_box(to.ref(g + 1, item.dst, c), gr.nodes[at(item.src)].place, packed_ref(p, size), {}, size);
      },
      [&](const Item& item) {
        for (int c = 0; c < nc; ++c)
          quadrant(local(item.src), to.ref(g + 1, item.dst, c), gr.nodes[at(item.src)].place, c);
      });
  const auto plane = [&](const Item& item, const ArrayRef<double>& dst, int c) {
    const ArrayRef<const double> x = from.ref(g, local(item.src), c);
    const int a = item.tag;
    for_each_cell({}, plane_size(g, item), [&](const IntVec& q) {
      IntVec fine{};
      for (int b = 0; b < DIM; ++b) fine[b] = b == a ? gr.layout.n : 2 * q[b];
      *dst.at(q) = value(x.at(fine), x.stride, a, false, true);
    });
  };
  const auto component_of = [&](const Item& item) {
    for (int c = 0; c < nc; ++c)
      if (from.component(c).normal == item.tag && plane_is_free(g, item, to.component(c))) return c;
    return -1;
  };
  run(
      routes_[at(g)].to_plane,
      [&](const Item& item) { return component_of(item) < 0 ? std::ptrdiff_t{0} : volume(plane_size(g, item)); },
      [&](const Item& item, double* p) {
        if (const int c = component_of(item); c >= 0) plane(item, packed_ref(p, plane_size(g, item)), c);
      },
      [&](const Item& item, const double* p) {
        const IntVec flat = plane_size(g, item);
        if (const int c = component_of(item); c >= 0) copy_box(plane_target(to, g, item, c), {}, packed_ref(p, flat), {}, flat);
      },
      [&](const Item& item) {
        if (const int c = component_of(item); c >= 0) plane(item, plane_target(to, g, item, c), c);
      });
}

IntVec Hierarchy::plane_size(int g, const Item& item) const {
  IntVec size = filled(grid(g).layout.n / 2);
  size[item.tag] = 1;
  return size;
}

bool Hierarchy::plane_is_free(int g, const Item& item, const Component& c) const {
  const Grid::Node& n = grid(g).nodes[at(item.src)];
  return n.neighbours[at(towards(item.tag, 1))] != Grid::OUTSIDE || !c.sides[at(face_of(item.tag, true))].odd;
}

ArrayRef<double> Hierarchy::plane_target(HierarchyField& to, int g, const Item& item, int c) const {
  const Grid::Node& n = grid(g).nodes[at(item.src)];
  const bool side = n.neighbours[at(towards(item.tag, 1))] == Grid::OUTSIDE;
  IntVec lo = n.place;
  lo[item.tag] = side ? lo[item.tag] + grid(g).layout.n / 2 : 0;
  ArrayRef<double> dst = to.ref(g + 1, item.dst, c);
  dst.p = dst.at(lo);
  return dst;
}

void Hierarchy::restrict_means(const HierarchyField& from, HierarchyField& to, int g) {
  restrict_by(from, to, g, [](const double* p, const Array<std::ptrdiff_t>& stride, int normal, bool, bool) {
    return mean_across(p, stride, normal);
  });
}

void Hierarchy::restrict_weighted(const std::function<Array<ArrayRef<const double>>(int)>& made, HierarchyField& to,
                                  int g) {
  const Grid& gr = grid(g);
  const int cells = gr.layout.n, half = cells / 2;
  const IntVec size = filled(half);
  const auto local = [&](const Item& item) { return gr.nodes[at(item.src)].local; };
  run(
      routes_[at(g)].to_parent, [&](const Item&) { return DIM * volume(size); },
      [&](const Item& item, double* p) {
        const Array<ArrayRef<const double>> x = made(local(item));
        for (int c = 0; c < DIM; ++c, p += volume(size)) take_weighted(packed_ref(p, size), x[c], c, cells);
      },
      [&](const Item& item, const double* p) {
        for (int c = 0; c < DIM; ++c, p += volume(size))
          copy_box(to.ref(g + 1, item.dst, c), gr.nodes[at(item.src)].place, packed_ref(p, size), {}, size);
      },
      [&](const Item& item) {
        const Array<ArrayRef<const double>> x = made(local(item));
        for (int c = 0; c < DIM; ++c) {
          ArrayRef<double> dst = to.ref(g + 1, item.dst, c);
          dst.p = dst.at(gr.nodes[at(item.src)].place);
          take_weighted(dst, x[c], c, cells);
        }
      });
  const auto plane = [&](const Item& item, const ArrayRef<double>& dst) {
    const int a = item.tag;
    const ArrayRef<const double> x = made(local(item))[a];
    for_each_cell({}, plane_size(g, item), [&](const IntVec& q) {
      IntVec fine{};
      for (int b = 0; b < DIM; ++b) fine[b] = b == a ? cells : 2 * q[b];
      const double* p = x.at(fine);
      *dst.at(q) = 0.75 * mean_across(p, x.stride, a) + 0.25 * mean_across(p - x.stride[a], x.stride, a);
    });
  };
  const auto is_free = [&](const Item& item) { return plane_is_free(g, item, to.component(item.tag)); };
  run(
      routes_[at(g)].to_plane, [&](const Item& item) { return is_free(item) ? volume(plane_size(g, item)) : 0; },
      [&](const Item& item, double* p) {
        if (is_free(item)) plane(item, packed_ref(p, plane_size(g, item)));
      },
      [&](const Item& item, const double* p) {
        const IntVec flat = plane_size(g, item);
        if (is_free(item)) copy_box(plane_target(to, g, item, item.tag), {}, packed_ref(p, flat), {}, flat);
      },
      [&](const Item& item) {
        if (is_free(item)) plane(item, plane_target(to, g, item, item.tag));
      });
}

void Hierarchy::restrict_links(HierarchyField& f, int g) {
  restrict_by(f, f, g, [](const double* p, const Array<std::ptrdiff_t>& stride, int normal, bool no_below, bool is_plane) {
    if (is_plane) return mean_across(p, stride, normal);
    const std::ptrdiff_t s = stride[normal];
    double sum = 0;
    for (int corner = 0; corner < CHILDREN; ++corner) {
      if ((corner >> normal & 1) != 0) continue;
      const double* q = p;
      for (int a = 0; a < DIM; ++a) q += (corner >> a & 1) != 0 ? stride[a] : 0;
      sum += 1 / (0.5 / q[0] + 0.25 / q[no_below ? 0 : -s] + 0.25 / q[s]);
    }
    return sum / (CHILDREN / 2);
  });
}

void Hierarchy::restrict_roots(HierarchyField& f, int g, std::span<const IntVec> shift) {
  const Layout& layout = grid(g).layout;
  const IntVec size = filled(layout.n / 2);
  const int components = static_cast<int>(shift.size());
  const auto local = [&](const Item& item) { return grid(g).nodes[at(item.src)].local; };
  const auto place = [&](const Item& item) { return grid(g).nodes[at(item.src)].place; };
  const auto quadrant = [&](int i, int c, const ArrayRef<double>& dst, const IntVec& lo) {
    const ArrayRef<const double> x = std::as_const(f).ref(g, i, 0);
    for_each_cell({}, size, [&](const IntVec& q) {
      IntVec fine{}, coarse{};
      for (int a = 0; a < DIM; ++a) {
        fine[a] = 2 * q[a] - shift[at(c)][a];
        coarse[a] = lo[a] + q[a];
      }
      const double* p = x.at(fine);
      double sum = 0;
      for (int corner = 0; corner < CHILDREN; ++corner) {
        std::ptrdiff_t o = 0;
        for (int a = 0; a < DIM; ++a) o += (corner >> a & 1) != 0 ? x.stride[a] : 0;
        sum += std::sqrt(p[o]);
      }
      *dst.at(coarse) = sum / CHILDREN * (sum / CHILDREN);
    });
  };
  run(
      routes_[at(g)].to_parent, [&](const Item&) { return components * volume(size); },
      [&](const Item& item, double* p) {
        for (int c = 0; c < components; ++c, p += volume(size)) quadrant(local(item), c, packed_ref(p, size), {});
      },
      [&](const Item& item, const double* p) {
        for (int c = 0; c < components; ++c, p += volume(size))
          copy_box(f.ref(g + 1, item.dst, c), place(item), packed_ref(p, size), {}, size);
      },
      [&](const Item& item) {
        for (int c = 0; c < components; ++c) quadrant(local(item), c, f.ref(g + 1, item.dst, c), place(item));
      });
}

void Hierarchy::restrict_made(const std::function<ArrayRef<const double>(int)>& array, HierarchyField& to, int g) {
  const Grid& gr = grid(g);
  const IntVec size = filled(gr.layout.n / 2);
  const auto local = [&](const Item& item) { return gr.nodes[at(item.src)].local; };
  run(
      routes_[at(g)].to_parent, [&](const Item&) { return volume(size); },
      [&](const Item& item, double* p) { restrict_box(packed_ref(p, size), {}, array(local(item)), {}, size); },
      [&](const Item& item, const double* p) {
        copy_box(to.ref(g + 1, item.dst, 0), gr.nodes[at(item.src)].place, packed_ref(p, size), {}, size);
      },
      [&](const Item& item) {
        restrict_box(to.ref(g + 1, item.dst, 0), gr.nodes[at(item.src)].place, array(local(item)), {}, size);
      });
}

void Hierarchy::match_fluxes(const HierarchyField& x, HierarchyField& y, int g, const HierarchyField& coefficients,
                             const Array<int>& kappa) {
  const Grid& gr = grid(g);
  const int cells = gr.layout.n;
  const auto size = [&](int axis) {
    IntVec s = filled(cells / 2);
    s[axis] = 1;
    return s;
  };
  // Mean over the finer faces of kappa times the difference inwards to outwards.
  const auto fluxes = [&](const Item& item, double* p) {
    const int a = face_axis(item.tag), i = gr.nodes[at(item.src)].local;
    const bool high = face_is_high(item.tag);
    const ArrayRef<const double> u = x.ref(g, i, 0);
    const double* k = kappa[a] < 0 ? nullptr : coefficients.at(g, i, kappa[a]);
    const std::ptrdiff_t out = high ? u.stride[a] : -u.stride[a], face = high ? u.stride[a] : 0;
    for_each_cell({}, size(a), [&](const IntVec& q) {
      IntVec fine{};
      for (int b = 0; b < DIM; ++b) fine[b] = b == a ? (high ? cells - 1 : 0) : 2 * q[b];
      double sum = 0;
      for (int corner = 0; corner < CHILDREN; ++corner) {
        if ((corner >> a & 1) != 0) continue;
        std::ptrdiff_t o = u.at(fine) - u.p;
        for (int b = 0; b < DIM; ++b) o += (corner >> b & 1) != 0 ? u.stride[b] : 0;
        sum += (k == nullptr ? 1.0 : k[o + face]) * (u.p[o] - u.p[o + out]);
      }
      *p++ = sum / (CHILDREN / 2);
    });
  };
  const auto use = [&](const Item& item, const double* p) {
    const int a = face_axis(item.tag);
    const bool high = face_is_high(item.tag);
    const Grid::Node& n = gr.nodes[at(item.src)];
    const ArrayRef<double> u = y.ref(g + 1, item.dst, 0);
    const double* k = kappa[a] < 0 ? nullptr : coefficients.at(g + 1, item.dst, kappa[a]);
    for_each_cell({}, size(a), [&](const IntVec& q) {
      IntVec c{};
      for (int b = 0; b < DIM; ++b) c[b] = b == a ? (high ? 0 : cells - 1) : n.place[b] + q[b];
      const std::ptrdiff_t o = u.at(c) - u.p, ghost = high ? -u.stride[a] : u.stride[a];
      const double weight = k == nullptr ? 2.0 : 2.0 / k[high ? o : o + ghost];  // half the spacing
      u.p[o + ghost] = u.p[o] + weight * *p++;
    });
  };
  run(
      routes_[at(g)].to_border, [&](const Item& item) { return volume(size(face_axis(item.tag))); }, fluxes, use,
      [&](const Item& item) {
        std::array<double, DIM == 2 ? 16 : 256> values;
        fluxes(item, values.data());
        use(item, values.data());
      });
}

void Hierarchy::make_composite(HierarchyField& f, int depth, bool homogeneous, bool parents) {
  const int last = parents ? levels_ - 1 : coarsest_leaf_;
  for (int g = 0; g < last; ++g) restrict_means(f, f, g);
  for (int g = last; g >= 0; --g) {
    fill_from_coarser(f, f, g);
    exchange(f, g, g == 0 ? depth : G, homogeneous);
  }
}

}  // namespace dendrift::amr

#include "amr/ghost.hpp"

#include <omp.h>

#include <algorithm>
#include <map>
#include <set>

namespace dendrift::amr {

namespace {

constexpr int G = Layout::GHOSTS;
constexpr int COARSE_GHOSTS = 2;  // one coarse cell under the fine ghosts, one more for the stencil

constexpr int TAG = 101;

}  // namespace

// One box of the surroundings of a leaf, by leaf numbers, before anybody asks who owns what.
struct GhostExchange::Source {
  int leaf;
  Copy copy;
};

GhostExchange::GhostExchange(Mesh& mesh) : mesh_(mesh), clocks_(static_cast<std::size_t>(omp_get_max_threads())) {}
GhostExchange::~GhostExchange() = default;

double GhostExchange::fill_seconds() const {
  double sum = 0;
  for (const Clock& c : clocks_) sum += c.seconds;
  return sum / static_cast<double>(clocks_.size());
}

std::ptrdiff_t GhostExchange::coarse_size() const {
  return volume(filled(mesh_.layout().n / 2 + 2 * COARSE_GHOSTS));
}

ArrayRef<double> GhostExchange::coarse_ref(double* p) const {
  ArrayRef<double> r = packed_ref(p, filled(mesh_.layout().n / 2 + 2 * COARSE_GHOSTS));
  r.p = r.at(filled(COARSE_GHOSTS));
  return r;
}

namespace {

// Bit d: what lies in direction d is coarser.
std::uint32_t coarser_directions(const Tree& tree, int leaf) {
  std::uint32_t bits = 0;
  for (int d = 0; d < DIRECTIONS; ++d)
    if (tree.neighbour(leaf, d).kind == Neighbour::Kind::coarser) bits |= 1U << d;
  return bits;
}

// Shrinks a box of the coarse copy of a block of n cells a side to what the stencils of prolongation into the ghosts of
// these directions read of it (as the sides of the domain mirror what is read, they ask for no more). False: nothing.
bool clip_to_stencils(std::uint32_t coarser, int n, IntVec& lo, IntVec& size) {
  IntVec first = filled(n), last = filled(-n);
  for (int d = 0; d < DIRECTIONS; ++d) {
    if ((coarser & (1U << d)) == 0) continue;
    const IntVec o = direction_offset(d);
    IntVec from{}, to{};
    bool empty = false;
    for (int a = 0; a < DIM; ++a) {
      from[a] = std::max(lo[a], o[a] < 0 ? -COARSE_GHOSTS : o[a] > 0 ? n / 2 - 1 : -1);
      to[a] = std::min(lo[a] + size[a], o[a] < 0 ? 1 : o[a] > 0 ? n / 2 + COARSE_GHOSTS : n / 2 + 1);
      empty |= from[a] >= to[a];
    }
    for (int a = 0; a < DIM && !empty; ++a) {
      first[a] = std::min(first[a], from[a]);
      last[a] = std::max(last[a], to[a]);
    }
  }
  if (first[0] >= last[0]) return false;
  lo = first;
  for (int a = 0; a < DIM; ++a) size[a] = last[a] - first[a];
  return true;
}

}  // namespace

void GhostExchange::copies_of(int leaf, std::vector<Source>& out) const {
  const Tree& tree = mesh_.tree();
  const int n = mesh_.layout().n;
  const IntVec coord = tree.leaf(leaf).coord;
  const std::uint32_t coarser = coarser_directions(tree, leaf);
  std::vector<FinerNeighbour> finer;
  for (int d = 0; d < DIRECTIONS; ++d) {
    if (d == CENTRE) continue;
    const IntVec o = direction_offset(d);
    const Neighbour nb = tree.neighbour(leaf, d);
    if (nb.kind == Neighbour::Kind::boundary) continue;
    Copy c;
    for (int a = 0; a < DIM; ++a) {
      c.dst_lo[a] = o[a] < 0 ? -G : o[a] > 0 ? n : 0;
      c.size[a] = o[a] == 0 ? n : G;
    }
    Copy k;  // the same direction in the coarse copy
    k.to_coarse = true;
    for (int a = 0; a < DIM; ++a) {
      k.dst_lo[a] = o[a] < 0 ? -COARSE_GHOSTS : o[a] > 0 ? n / 2 : 0;
      k.size[a] = o[a] == 0 ? n / 2 : COARSE_GHOSTS;
    }
    if (nb.kind == Neighbour::Kind::same) {
      for (int a = 0; a < DIM; ++a) c.src_lo[a] = c.dst_lo[a] - o[a] * n;
      out.push_back({nb.leaf, c});
      if (clip_to_stencils(coarser, n, k.dst_lo, k.size)) {
        k.restricts = true;
        for (int a = 0; a < DIM; ++a) k.src_lo[a] = 2 * k.dst_lo[a] - o[a] * n;
        out.push_back({nb.leaf, k});
      }
    } else if (nb.kind == Neighbour::Kind::coarser) {
      // Coarse cells of this block start at (coord % 2) n/2 inside its parent; the parent's neighbour in
      // direction q starts n cells further.
      for (int a = 0; a < DIM; ++a) {
        const int in_parent = (coord[a] & 1) * (n / 2) + k.dst_lo[a];
        const int q = in_parent < 0 ? -1 : in_parent >= n ? 1 : 0;
        k.src_lo[a] = in_parent - q * n;
      }
      out.push_back({nb.leaf, k});
    } else {
      finer.clear();
      tree.finer_neighbours(leaf, d, finer);
      for (const FinerNeighbour& f : finer) {
        Copy r = c;
        r.restricts = true;
        for (int a = 0; a < DIM; ++a) {
          if (o[a] == 0) {
            r.size[a] = n / 2;
            r.dst_lo[a] = f.child[a] * (n / 2);
          }
          r.src_lo[a] = 2 * (r.dst_lo[a] - o[a] * n) - f.child[a] * n;
        }
        out.push_back({f.leaf, r});
      }
    }
  }
}

void GhostExchange::rebuild() {
  const Tree& tree = mesh_.tree();
  const int me = mesh_.rank();
  copies_.clear();
  plans_.clear();
  inner_.clear();
  outer_.clear();
  messages_.clear();
  std::map<int, Message> by_rank;
  std::set<int> foreign;  // leaves of other ranks that touch ours
  std::vector<Source> sources;
  for (int b = 0; b < mesh_.size(); ++b) {
    const int leaf = mesh_.block(b).leaf;
    Plan plan;
    plan.first = static_cast<int>(copies_.size());
    plan.coarser = coarser_directions(tree, leaf);
    plan.rim_size = filled(mesh_.layout().n / 2);
    clip_to_stencils(plan.coarser, mesh_.layout().n, plan.rim_lo, plan.rim_size);
    for (int f = 0; f < FACES; ++f) {
      const int d = direction_index(face_offset(f));
      if (tree.neighbour(leaf, d).kind == Neighbour::Kind::boundary) plan.outside |= 1U << f;
    }
    sources.clear();
    copies_of(leaf, sources);
    bool remote = false;
    for (Source& s : sources) {
      const int owner = mesh_.owner(s.leaf);
      if (owner == me) {
        s.copy.slot = mesh_.block(mesh_.local(s.leaf)).slot;
      } else {
        Message& m = by_rank[owner];
        s.copy.packed = m.recv_cells;
        s.copy.message = owner;
        m.recv_cells += volume(s.copy.size);
        remote = true;
      }
      copies_.push_back(s.copy);
    }
    plan.last = static_cast<int>(copies_.size());
    plans_.push_back(plan);
    (remote ? outer_ : inner_).push_back(b);
    if (!remote) continue;
    for (const int t : tree.touching(leaf))
      if (mesh_.owner(t) != me) foreign.insert(t);
  }
  // The sender lists its boxes in the receiver's order: by destination leaf, then as copies_of lists them.
  for (const int leaf : foreign) {
    sources.clear();
    copies_of(leaf, sources);
    Message& m = by_rank[mesh_.owner(leaf)];
    for (Source& s : sources) {
      if (mesh_.owner(s.leaf) != me) continue;
      s.copy.slot = mesh_.block(mesh_.local(s.leaf)).slot;
      s.copy.packed = m.send_cells;
      m.send_cells += volume(s.copy.size);
      m.sends.push_back(s.copy);
    }
  }
  std::map<int, int> position;
  for (auto& [rank, m] : by_rank) {
    m.rank = rank;
    position[rank] = static_cast<int>(messages_.size());
    messages_.push_back(std::move(m));
  }
  for (Copy& c : copies_)
    if (c.message >= 0) c.message = position[c.message];
  generation_ = mesh_.generation();
}

void GhostExchange::start(std::vector<CellField> fields) {
  if (generation_ != mesh_.generation()) rebuild();
  fields_ = std::move(fields);
  requests_.clear();
  const std::size_t nf = fields_.size();
  for (Message& m : messages_) {
    m.recv.resize(static_cast<std::size_t>(m.recv_cells) * nf);
    m.send.resize(static_cast<std::size_t>(m.send_cells) * nf);
    MPI_Request r;
    MPI_Irecv(m.recv.data(), static_cast<int>(m.recv.size()), MPI_DOUBLE, m.rank, TAG, mesh_.comm(), &r);
    requests_.push_back(r);
  }
  for (Message& m : messages_) {
    parallel_for(static_cast<int>(m.sends.size()), [&](int i) {
      const Copy& c = m.sends[static_cast<std::size_t>(i)];
      for (std::size_t f = 0; f < nf; ++f) {
        double* p = m.send.data() + c.packed * static_cast<std::ptrdiff_t>(nf) +
                    static_cast<std::ptrdiff_t>(f) * volume(c.size);
        Copy to_buffer = c;
        to_buffer.dst_lo = {};
        run_copy(to_buffer, fields_[f], f, packed_ref(p, c.size));
      }
    });
    MPI_Request r;
    MPI_Isend(m.send.data(), static_cast<int>(m.send.size()), MPI_DOUBLE, m.rank, TAG, mesh_.comm(), &r);
    requests_.push_back(r);
  }
}

void GhostExchange::wait() {
  if (requests_.empty()) return;
  const double t0 = MPI_Wtime();
  MPI_Waitall(static_cast<int>(requests_.size()), requests_.data(), MPI_STATUSES_IGNORE);
  requests_.clear();
  wait_seconds_ += MPI_Wtime() - t0;
}

void GhostExchange::run_copy(const Copy& c, CellField f, std::size_t field, ArrayRef<double> dst) const {
  if (c.slot < 0) {
    const Message& m = messages_[static_cast<std::size_t>(c.message)];
    const double* p = m.recv.data() + c.packed * static_cast<std::ptrdiff_t>(fields_.size()) +
                      static_cast<std::ptrdiff_t>(field) * volume(c.size);
    copy_box(dst, c.dst_lo, packed_ref(p, c.size), {}, c.size);
    return;
  }
  const Mesh& mesh = mesh_;
  const ArrayRef<const double> src = array_ref(mesh.array(f.id, c.slot), mesh.layout());
  if (c.restricts) {
    restrict_cells(mesh.fields().row(f.id), dst, c.dst_lo, src, c.src_lo, c.size);
  } else {
    copy_box(dst, c.dst_lo, src, c.src_lo, c.size);
  }
}

void GhostExchange::apply_sides(std::uint32_t outside, const FieldSpec& spec, ArrayRef<double> a, int cells,
                                int ghosts) const {
  // Axis by axis over all rows, ghosts included, so that edges and corners follow from what is there.
  for (int axis = 0; axis < DIM; ++axis) {
    for (int high = 0; high < 2; ++high) {
      const int face = 2 * axis + high;
      if ((outside & (1U << face)) == 0) continue;
      const SideRule rule = spec.sides[static_cast<std::size_t>(face)];
      IntVec lo = filled(-ghosts), size = filled(cells + 2 * ghosts);
      size[axis] = 1;
      for (int g = 0; g < ghosts; ++g) {
        IntVec mirror = lo;
        lo[axis] = high != 0 ? cells + g : -1 - g;
        mirror[axis] = high != 0 ? cells - 1 - g : g;
        if (rule.kind == SideRule::Kind::value) {
          for_each_cell(lo, size, [&](const IntVec& c) { *a.at(c) = rule.value; });
        } else {
          copy_box(a, lo, {a.p, a.stride}, mirror, size);
        }
      }
    }
  }
}

void GhostExchange::fill_coarse_and_prolong(const Plan& plan, CellField field, int b, double* coarse) const {
  const int n = mesh_.layout().n;
  const ArrayRef<double> block = array_ref(mesh_.cells(field, b), mesh_.layout());
  const ArrayRef<double> c = coarse_ref(coarse);
  const FieldSpec& spec = mesh_.fields().row(field.id);
  IntVec from = plan.rim_lo;
  for (int& x : from) x *= 2;
  restrict_cells(spec, c, plan.rim_lo, {block.p, block.stride}, from, plan.rim_size);
  apply_sides(plan.outside, spec, c, n / 2, COARSE_GHOSTS);
  for (int d = 0; d < DIRECTIONS; ++d) {
    if ((plan.coarser & (1U << d)) == 0) continue;
    const IntVec o = direction_offset(d);
    IntVec lo{}, size{};
    for (int a = 0; a < DIM; ++a) {
      lo[a] = o[a] < 0 ? -G : o[a] > 0 ? n : 0;
      size[a] = o[a] == 0 ? n : G;
    }
    prolong_cells(spec, block, lo, {c.p, c.stride}, size);
  }
}

void GhostExchange::fill_block(int b) {
  const double begin = omp_get_wtime();
  const Plan& plan = plans_[static_cast<std::size_t>(b)];
  thread_local std::vector<double> coarse;
  coarse.resize(static_cast<std::size_t>(coarse_size()));
  for (std::size_t f = 0; f < fields_.size(); ++f) {
    const ArrayRef<double> block = array_ref(mesh_.cells(fields_[f], b), mesh_.layout());
    const ArrayRef<double> c = coarse_ref(coarse.data());
    for (int i = plan.first; i < plan.last; ++i) {
      const Copy& copy = copies_[static_cast<std::size_t>(i)];
      run_copy(copy, fields_[f], f, copy.to_coarse ? c : block);
    }
    if (plan.coarser != 0) fill_coarse_and_prolong(plan, fields_[f], b, coarse.data());
    if (plan.outside != 0) apply_sides(plan.outside, mesh_.fields().row(fields_[f].id), block, mesh_.layout().n, G);
  }
  clocks_[static_cast<std::size_t>(omp_get_thread_num())].seconds += omp_get_wtime() - begin;
}

void GhostExchange::fill(std::vector<CellField> fields) {
  fill_and_run(std::move(fields), [](int) {});
}

}  // namespace dendrift::amr

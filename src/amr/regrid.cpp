#include "amr/regrid.hpp"

#include <algorithm>
#include <map>

#include "amr/comm.hpp"
#include "amr/face_transfer.hpp"

namespace dendrift::amr {

namespace {

constexpr int TAG_MIGRATE = 103;
constexpr int TAG_RESTRICT = 104;

std::size_t at(int i) { return static_cast<std::size_t>(i); }

struct LeafTag {
  int leaf;
  Tag tag;
};

// Wanted change of every leaf of the old tree, demands of neighbours included.
std::vector<std::int8_t> wanted_changes(const Tree& tree, std::span<const Tag> tags) {
  std::vector<std::int8_t> change(at(tree.size()), 0);
  std::vector<int> need(at(tree.size())), keep(at(tree.size()));
  for (int i = 0; i < tree.size(); ++i) {
    need[at(i)] = std::max(need[at(i)], tags[at(i)].level);
    keep[at(i)] = std::max(keep[at(i)], std::max(tags[at(i)].keep, tags[at(i)].level));
    std::vector<FinerNeighbour> finer;
    for (int d = 0; d < DIRECTIONS; ++d) {
      if ((tags[at(i)].reach & (1U << d)) == 0 || d == CENTRE) continue;
      const Neighbour n = tree.neighbour(i, d);
      auto demand = [&](int leaf) {
        need[at(leaf)] = std::max(need[at(leaf)], tags[at(i)].reach_level);
        keep[at(leaf)] = std::max(keep[at(leaf)], tags[at(i)].reach_level);
      };
      if (n.leaf >= 0) demand(n.leaf);
      if (n.kind == Neighbour::Kind::finer) {
        finer.clear();
        tree.finer_neighbours(i, d, finer);
        for (const FinerNeighbour& f : finer) demand(f.leaf);
      }
    }
  }
  for (int i = 0; i < tree.size(); ++i) {
    const int level = tree.leaf(i).level;
    if (need[at(i)] > level) change[at(i)] = 1;
    if (keep[at(i)] < level) change[at(i)] = -1;
  }
  return change;
}

IntVec child_place(const BlockIndex& b) {
  IntVec p{};
  for (int a = 0; a < DIM; ++a) p[a] = b.coord[a] & 1;
  return p;
}

bool is_origin(const IntVec& p) { return p == IntVec{}; }

// Builds the slots of the new leaves from the old blocks; all data moves stay on the rank of the old data but
// for families whose members lived on several ranks.
class Rebuilder {
 public:
  Rebuilder(Mesh& mesh, const Tree& next) : mesh_(mesh), next_(next), fields_(mesh.fields().transferred()) {
    owners_.assign(at(next.size()), -1);
    slots_.assign(at(next.size()), -1);
  }

  void run() {
    const Tree& old = mesh_.tree();
    for (int i = 0; i < next_.size(); ++i) {
      const BlockIndex& b = next_.leaf(i);
      const int j = old.locate(b);
      owners_[at(i)] = mesh_.owner(j);  // same leaf, parent, or first of the former family
      const int level = old.leaf(j).level;
      if (level == b.level) keep(i, j);
      if (level < b.level) refine(i, j);
      if (level > b.level) coarsen(i, j);
    }
    finish_messages();
    for (const int slot : retired_) mesh_.release_slot(slot);
    mesh_.install(next_, owners_, slots_);
  }

 private:
  bool ours(int leaf) const { return mesh_.owner(leaf) == mesh_.rank(); }
  int slot_of(int old_leaf) const { return mesh_.block(mesh_.local(old_leaf)).slot; }
  ArrayRef<double> ref(int field, int slot) { return array_ref(mesh_.array(field, slot), mesh_.layout()); }
  int normal(int field) const { return mesh_.fields().row(field).normal; }
  IntVec half_extent(int field) const { return mesh_.fields().extent(field, mesh_.layout().n / 2); }
  std::ptrdiff_t half_values() const {
    std::ptrdiff_t sum = 0;
    for (const int f : fields_) sum += volume(half_extent(f));
    return sum;
  }
  void restrict_field(int field, ArrayRef<double> dst, const IntVec& lo, int slot) {
    const ArrayRef<double> s = ref(field, slot);
    const IntVec half = filled(mesh_.layout().n / 2);
    if (normal(field) < 0) {
      restrict_cells(mesh_.fields().row(field), dst, lo, {s.p, s.stride}, {}, half);
    } else {
      restrict_faces(dst, lo, {s.p, s.stride}, half, normal(field));
    }
  }

  void keep(int i, int j) {
    if (ours(j)) slots_[at(i)] = slot_of(j);
  }

  void refine(int i, int j) {
    if (!ours(j)) return;
    const int n = mesh_.layout().n;
    const int parent = slot_of(j);
    const int slot = mesh_.acquire_slot();
    slots_[at(i)] = slot;
    const IntVec place = child_place(next_.leaf(i));
    IntVec corner{};
    for (int a = 0; a < DIM; ++a) corner[a] = place[a] * n / 2;
    for (const int f : fields_) {
      const ArrayRef<double> p = ref(f, parent);
      if (normal(f) < 0)
        prolong_cells(mesh_.fields().row(f), ref(f, slot), {}, {p.at(corner), p.stride}, filled(n));
      if (normal(f) != 0) continue;
      Array<ArrayRef<double>> fine{};
      Array<ArrayRef<const double>> coarse{};
      for (int a = 0; a < DIM; ++a) {
        const ArrayRef<double> q = ref(f + a, parent);
        fine[a] = ref(f + a, slot);
        coarse[a] = {q.at(corner), q.stride};
      }
      prolong_faces(fine, coarse, n);
    }
    if (is_origin(place)) retired_.push_back(parent);
  }

  void coarsen(int i, int first) {
    const int n = mesh_.layout().n;
    const int owner = owners_[at(i)];
    if (owner == mesh_.rank()) slots_[at(i)] = mesh_.acquire_slot();
    for (int m = 0; m < CHILDREN; ++m) {
      const int j = first + m;
      IntVec corner = child_place(mesh_.tree().leaf(j));
      for (int& c : corner) c *= n / 2;
      if (ours(j) && owner == mesh_.rank()) {
        for (const int f : fields_) restrict_field(f, ref(f, slots_[at(i)]), corner, slot_of(j));
      } else if (ours(j)) {
        std::vector<double>& buffer = sends_[owner];
        for (const int f : fields_) {
          const std::size_t before = buffer.size();
          buffer.resize(before + static_cast<std::size_t>(volume(half_extent(f))));
          restrict_field(f, packed_ref(buffer.data() + before, half_extent(f)), {}, slot_of(j));
        }
      } else if (owner == mesh_.rank()) {
        expected_[mesh_.owner(j)].push_back({slots_[at(i)], corner});
      }
      if (ours(j)) retired_.push_back(slot_of(j));
    }
  }

  void finish_messages() {
    const auto each = static_cast<std::size_t>(half_values());
    std::map<int, std::vector<double>> received;
    std::vector<MPI_Request> requests;
    for (auto& [rank, list] : expected_) {
      std::vector<double>& buffer = received[rank];
      buffer.resize(list.size() * each);
      MPI_Irecv(buffer.data(), static_cast<int>(buffer.size()), MPI_DOUBLE, rank, TAG_RESTRICT, mesh_.comm(),
                &requests.emplace_back());
    }
    for (auto& [rank, buffer] : sends_)
      MPI_Isend(buffer.data(), static_cast<int>(buffer.size()), MPI_DOUBLE, rank, TAG_RESTRICT, mesh_.comm(),
                &requests.emplace_back());
    MPI_Waitall(static_cast<int>(requests.size()), requests.data(), MPI_STATUSES_IGNORE);
    for (auto& [rank, list] : expected_) {
      const double* p = received[rank].data();
      for (const auto& [slot, corner] : list) {
        for (const int f : fields_) {
          const IntVec half = half_extent(f);
          copy_box(ref(f, slot), corner, packed_ref(p, half), {}, half);
          p += volume(half);
        }
      }
    }
  }

  Mesh& mesh_;
  const Tree& next_;
  std::vector<int> fields_;
  std::vector<int> owners_, slots_;
  std::vector<int> retired_;
  std::map<int, std::vector<double>> sends_;
  std::map<int, std::vector<std::pair<int, IntVec>>> expected_;
};

}  // namespace

Proposal propose(const Mesh& mesh, std::span<const Tag> tags) {
  const Tree& tree = mesh.tree();
  std::vector<LeafTag> mine;
  for (int b = 0; b < mesh.size(); ++b) mine.push_back({mesh.block(b).leaf, tags[at(b)]});
  std::vector<Tag> all(at(tree.size()));
  for (const LeafTag& t : all_gather(std::span<const LeafTag>(mine), mesh.comm())) all[at(t.leaf)] = t.tag;
  const std::vector<std::int8_t> change = wanted_changes(tree, all);
  const bool quiet = std::all_of(change.begin(), change.end(), [](std::int8_t c) { return c == 0; });
  Proposal p{quiet ? tree : tree.adapted(change), {}, false};
  p.changed = !std::ranges::equal(p.tree.leaves(), tree.leaves());
  for (const BlockIndex& b : p.tree.leaves()) p.weights.push_back(all[at(tree.locate(b))].weight);
  return p;
}

void migrate(Mesh& mesh, const std::vector<int>& owners) {
  const std::vector<int> fields = mesh.fields().transferred();
  const auto extent = [&](int field) { return mesh.fields().extent(field, mesh.layout().n); };
  std::size_t each = 0;
  for (const int f : fields) each += static_cast<std::size_t>(volume(extent(f)));
  const int me = mesh.rank();
  std::map<int, std::vector<double>> sends, receives;
  std::vector<int> slots(owners.size(), -1), retired;
  for (int i = 0; i < mesh.tree().size(); ++i) {
    const int from = mesh.owner(i), to = owners[at(i)];
    if (from == me && to == me) slots[at(i)] = mesh.block(mesh.local(i)).slot;
    if (from == to) continue;
    if (from == me) {
      std::vector<double>& buffer = sends[to];
      const int slot = mesh.block(mesh.local(i)).slot;
      for (const int f : fields) {
        const std::size_t before = buffer.size();
        const IntVec n = extent(f);
        buffer.resize(before + static_cast<std::size_t>(volume(n)));
        const ArrayRef<double> s = array_ref(mesh.array(f, slot), mesh.layout());
        copy_box(packed_ref(buffer.data() + before, n), {}, {s.p, s.stride}, {}, n);
      }
      retired.push_back(slot);
    } else if (to == me) {
      std::vector<double>& buffer = receives[from];
      buffer.resize(buffer.size() + each);
    }
  }
  std::vector<MPI_Request> requests;
  for (auto& [rank, buffer] : receives)
    MPI_Irecv(buffer.data(), static_cast<int>(buffer.size()), MPI_DOUBLE, rank, TAG_MIGRATE, mesh.comm(),
              &requests.emplace_back());
  for (auto& [rank, buffer] : sends)
    MPI_Isend(buffer.data(), static_cast<int>(buffer.size()), MPI_DOUBLE, rank, TAG_MIGRATE, mesh.comm(),
              &requests.emplace_back());
  MPI_Waitall(static_cast<int>(requests.size()), requests.data(), MPI_STATUSES_IGNORE);
  for (const int slot : retired) mesh.release_slot(slot);
  std::map<int, std::size_t> read;
  for (int i = 0; i < mesh.tree().size(); ++i) {
    const int from = mesh.owner(i);
    if (from == me || owners[at(i)] != me) continue;
    slots[at(i)] = mesh.acquire_slot();
    for (const int f : fields) {
      const double* p = receives[from].data() + read[from];
      const IntVec n = extent(f);
      copy_box(array_ref(mesh.array(f, slots[at(i)]), mesh.layout()), {}, packed_ref(p, n), {}, n);
      read[from] += static_cast<std::size_t>(volume(n));
    }
  }
  mesh.install(mesh.tree(), owners, slots);
}

bool regrid(Mesh& mesh, GhostExchange& ghosts, const Proposal& proposal, const RegridOptions& options) {
  if (proposal.changed) {
    ghosts.fill(mesh.fields().transferred_cells());  // prolongation looks one cell beyond the block
    Rebuilder(mesh, proposal.tree).run();
  }
  if (mesh.ranks() > 1 && imbalance(proposal.weights, mesh.owners(), mesh.ranks()) > options.max_imbalance) {
    const std::vector<int> owners =
        partition(options.partitioner, mesh.tree(), proposal.weights, mesh.ranks());
    if (!std::ranges::equal(owners, mesh.owners())) {
      migrate(mesh, owners);
      return true;
    }
  }
  return proposal.changed;
}

}  // namespace dendrift::amr

#include "amr/coarser_mesh.hpp"

#include <algorithm>

#include "amr/face_transfer.hpp"

namespace dendrift::amr {

namespace {

constexpr int TAG = 140;

std::size_t at(int i) { return static_cast<std::size_t>(i); }

}  // namespace

CoarserMesh::CoarserMesh(Mesh& fine, const FieldTable& fields) : fine_(fine), mesh_(fine.shape(), fields, fine.comm()) {
  for (int row = 0; row < fields.size(); ++row) fine_rows_.push_back(fine.fields().find(fields.row(row).name).value());
  const Tree& old = fine.tree();
  std::vector<std::int8_t> change(at(old.size()), 0);
  for (int i = 0; i < old.size(); ++i)
    if (old.leaf(i).level == old.max_level()) change[at(i)] = -1;
  Tree tree = old.max_level() > 0 ? old.adapted(change) : old;
  std::vector<int> owners;
  for (const BlockIndex& b : tree.leaves()) owners.push_back(fine.owner(old.locate(b)));
  for (const Block& b : mesh_.blocks()) mesh_.release_slot(b.slot);
  mesh_.install(std::move(tree), std::move(owners), std::vector<int>(at(old.size()), -1));
  const int me = fine.rank();
  for (int i = 0; i < mesh_.tree().size(); ++i) {
    const int first = old.locate(mesh_.tree().leaf(i));
    if (old.leaf(first).level == mesh_.tree().leaf(i).level) {
      if (mesh_.owner(i) == me) common_.push_back({i, first});
      continue;
    }
    for (int j = first; j < first + CHILDREN; ++j) {
      Child c{i, j, {}};
      for (int a = 0; a < DIM; ++a) c.corner[a] = (old.leaf(j).coord[a] & 1) * mesh_.layout().n / 2;
      const int parent = mesh_.owner(i), child = fine.owner(j);
      if (parent == me && child == me) {
        local_.push_back(c);
      } else if (child == me) {
        children_[parent].push_back(c);
      } else if (parent == me) {
        parents_[child].push_back(c);
      }
    }
  }
}

std::vector<int> CoarserMesh::rows(const FieldList& fields) {
  std::vector<int> list;
  for (const CellField f : fields.cells) list.push_back(f.id);
  for (const FaceField f : fields.faces)
    for (int a = 0; a < DIM; ++a) list.push_back(f.id + a);
  return list;
}

// Each child of `out` is packed here, each of `in` unpacked; both ranks hold their lists in the same order.
template <class Pack, class Unpack>
void CoarserMesh::send(const std::map<int, std::vector<Child>>& out, const std::map<int, std::vector<Child>>& in,
                       std::ptrdiff_t each, Pack&& pack, Unpack&& unpack) const {
  std::vector<MPI_Request> requests;
  std::map<int, std::vector<double>> received, sent;
  const auto buffer = [&](std::map<int, std::vector<double>>& all, int rank, std::size_t count) -> std::vector<double>& {
    std::vector<double>& b = all[rank];
    b.resize(count * static_cast<std::size_t>(each));
    return b;
  };
  for (const auto& [rank, list] : in) {
    std::vector<double>& b = buffer(received, rank, list.size());
    MPI_Irecv(b.data(), static_cast<int>(b.size()), MPI_DOUBLE, rank, TAG, mesh_.comm(), &requests.emplace_back());
  }
  for (const auto& [rank, list] : out) {
    std::vector<double>& b = buffer(sent, rank, list.size());
    double* p = b.data();
    for (const Child& c : list) {
      pack(c, p);
      p += each;
    }
    MPI_Isend(b.data(), static_cast<int>(b.size()), MPI_DOUBLE, rank, TAG, mesh_.comm(), &requests.emplace_back());
  }
  MPI_Waitall(static_cast<int>(requests.size()), requests.data(), MPI_STATUSES_IGNORE);
  for (const auto& [rank, list] : in) {
    const double* p = received[rank].data();
    for (const Child& c : list) {
      unpack(c, p);
      p += each;
    }
  }
}

void CoarserMesh::restrict_child(int row, const Child& child, ArrayRef<double> to, const IntVec& lo) {
  const ArrayRef<double> from = fine_ref(row, child.leaf);
  const IntVec half = filled(mesh_.layout().n / 2);
  const int normal = mesh_.fields().row(row).normal;
  if (normal < 0) {
    restrict_cells(mesh_.fields().row(row), to, lo, {from.p, from.stride}, {}, half);
  } else {
    restrict_faces(to, lo, {from.p, from.stride}, half, normal);
  }
}

void CoarserMesh::take(const FieldList& fields) {
  const std::vector<int> list = rows(fields);
  std::ptrdiff_t each = 0;
  for (const int row : list) each += volume(half_extent(row));
  parallel_for(static_cast<int>(common_.size()), [&](int i) {
    const auto [coarse, fine] = common_[at(i)];
    for (const int row : list)
      copy_box(ref(row, coarse), {}, {fine_ref(row, fine).p, fine_ref(row, fine).stride}, {}, extent(row));
  });
  // A family at a time, by its first child: siblings write the faces between them both.
  parallel_for(static_cast<int>(local_.size()), [&](int i) {
    const int parent = local_[at(i)].parent;
    if (i > 0 && local_[at(i - 1)].parent == parent) return;
    for (auto c = local_.begin() + i; c != local_.end() && c->parent == parent; ++c)
      for (const int row : list) restrict_child(row, *c, ref(row, parent), c->corner);
  });
  send(
      children_, parents_, each,
      [&](const Child& c, double* p) {
        for (const int row : list) {
          restrict_child(row, c, packed_ref(p, half_extent(row)), {});
          p += volume(half_extent(row));
        }
      },
      [&](const Child& c, const double* p) {
        for (const int row : list) {
          copy_box(ref(row, c.parent), c.corner, packed_ref(p, half_extent(row)), {}, half_extent(row));
          p += volume(half_extent(row));
        }
      });
}

// to[i]: where row i of rows(fields) goes.
void CoarserMesh::prolong_child(const FieldList& fields, const Child& child, const std::vector<ArrayRef<double>>& to) {
  const auto from = [&](int row) {
    const ArrayRef<double> r = ref(row, child.parent);
    return ArrayRef<const double>{r.at(child.corner), r.stride};
  };
  std::size_t next = 0;
  for (const CellField f : fields.cells) prolong_box(to[next++], {}, from(f.id), filled(mesh_.layout().n));
  for (const FaceField f : fields.faces) {
    Array<ArrayRef<double>> fine{};
    Array<ArrayRef<const double>> coarse{};
    for (int a = 0; a < DIM; ++a) {
      fine[a] = to[next++];
      coarse[a] = from(f.id + a);
    }
    prolong_faces(fine, coarse, mesh_.layout().n);
  }
}

void CoarserMesh::give(const FieldList& fields) {
  give_common(fields);
  const std::vector<int> list = rows(fields);
  std::ptrdiff_t each = 0;
  for (const int row : list) each += volume(extent(row));
  parallel_for(static_cast<int>(local_.size()), [&](int i) {
    const Child& c = local_[at(i)];
    std::vector<ArrayRef<double>> to;
    for (const int row : list) to.push_back(fine_ref(row, c.leaf));
    prolong_child(fields, c, to);
  });
  send(
      parents_, children_, each,
      [&](const Child& c, double* p) {
        std::vector<ArrayRef<double>> to;
        for (const int row : list) {
          to.push_back(packed_ref(p, extent(row)));
          p += volume(extent(row));
        }
        prolong_child(fields, c, to);
      },
      [&](const Child& c, const double* p) {
        for (const int row : list) {
          copy_box(fine_ref(row, c.leaf), {}, packed_ref(p, extent(row)), {}, extent(row));
          p += volume(extent(row));
        }
      });
}

void CoarserMesh::give_common(const FieldList& fields) {
  const std::vector<int> list = rows(fields);
  const std::ptrdiff_t origin = mesh_.layout().interior();
  parallel_for(static_cast<int>(common_.size()), [&](int i) {
    const auto [coarse, fine] = common_[at(i)];
    for (const int row : list)
      std::copy_n(ref(row, coarse).p - origin, mesh_.layout().size(), fine_ref(row, fine).p - origin);
  });
}

}  // namespace dendrift::amr

/// \file
/// A mesh without its finest level, and the way of data there and back: for what needs no finer cells.
#pragma once

#include <map>
#include <vector>

#include "amr/mesh.hpp"
#include "amr/transfer.hpp"

namespace dendrift::amr {

/// Handles of fields of the coarser mesh.
struct FieldList {
  std::vector<CellField> cells;
  std::vector<FaceField> faces;
};

/// Leaves of the finest level that the shape allows are replaced by their parents, each on the rank of its first child; all
/// others are the same, on the same ranks. Build it anew when the mesh has changed. All calls are collective.
class CoarserMesh {
 public:
  /// `fields`: rows of the coarser mesh; `fine` has rows of the same names.
  CoarserMesh(Mesh& fine, const FieldTable& fields);

  Mesh& mesh() { return mesh_; }

  /// From the fine mesh: means over what a cell or a face covers. No ghosts.
  void take(const FieldList& fields);
  /// To the fine mesh, third order; ghosts here have been filled. Means are kept, and what has no divergence gets none.
  void give(const FieldList& fields);
  /// The same for blocks that both meshes have only; their ghosts too.
  void give_common(const FieldList& fields);

 private:
  struct Child {
    int parent, leaf;  // of the coarser mesh, of the fine one
    IntVec corner;     // cell of the parent where it begins
  };
  struct Pair {
    int coarse, fine;
  };
  ArrayRef<double> ref(int row, int leaf) { return array_ref(mesh_.array(row, slot(mesh_, leaf)), mesh_.layout()); }
  ArrayRef<double> fine_ref(int row, int leaf) { return array_ref(fine_.array(fine_row(row), slot(fine_, leaf)), mesh_.layout()); }
  static int slot(const Mesh& m, int leaf) { return m.block(m.local(leaf)).slot; }
  int fine_row(int row) const { return fine_rows_[static_cast<std::size_t>(row)]; }
  static std::vector<int> rows(const FieldList& fields);
  IntVec half_extent(int row) const { return mesh_.fields().extent(row, mesh_.layout().n / 2); }
  IntVec extent(int row) const { return mesh_.fields().extent(row, mesh_.layout().n); }
  void restrict_child(int row, const Child& child, ArrayRef<double> to, const IntVec& lo);
  void prolong_child(const FieldList& fields, const Child& child, const std::vector<ArrayRef<double>>& to);
  template <class Pack, class Unpack>
  void send(const std::map<int, std::vector<Child>>& out, const std::map<int, std::vector<Child>>& in, std::ptrdiff_t each,
            Pack&& pack, Unpack&& unpack) const;

  Mesh& fine_;
  Mesh mesh_;
  std::vector<int> fine_rows_;  // of the rows of mesh_
  std::vector<Pair> common_;  // leaves of this rank
  std::vector<Child> local_;    // child and parent are this rank's
  std::map<int, std::vector<Child>> children_, parents_;  // one of them is, the other is the key's
};

}  // namespace dendrift::amr

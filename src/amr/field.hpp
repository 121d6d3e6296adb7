/// \file
/// The table of fields: one row a field drives allocation, ghost filling, regridding, output and the docs.
#pragma once

#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "amr/dim.hpp"

namespace dendrift::amr {

enum class Centring : std::uint8_t { cell, face };

/// What regridding does to the data of a field.
enum class Transfer : std::uint8_t {
  none,          ///< not kept: scratch, or recomputed by its module after every change of the mesh
  conservative,  ///< kept; between levels as `mixing` says
};

/// How values pass between levels, for ghost cells and for new blocks alike.
enum class Mixing : std::uint8_t {
  means,   ///< third-order interpolation, and the mean of the children
  angles,  ///< values equal modulo FieldSpec::period: differences are wrapped; linear between neighbours, no new extremes
  labels,  ///< never mixed: children take the value of their parent, a parent that of its first child
};

/// Rule for ghost cells beyond a side of the domain that is not periodic.
struct SideRule {
  enum class Kind : std::uint8_t { even, value };  ///< even: mirror image, zero normal gradient
  Kind kind = Kind::even;
  double value = 0;
};

/// One row of the table.
struct FieldSpec {
  std::string name;    ///< of the array, unique
  std::string symbol;  ///< as in docs/equations.md
  std::string unit;    ///< of the stored numbers
  std::string doc;
  Centring centring = Centring::cell;
  int normal = -1;       ///< of the faces, where they carry the field
  Transfer transfer = Transfer::none;
  Mixing mixing = Mixing::means;
  double period = 0;     ///< of angles
  bool checkpoint = false;
  std::array<SideRule, FACES> sides{};
};

/// Typed handles; a kernel never sees a name or a number.
struct CellField {
  int id = -1;
};
/// DIM components; component a lives on the faces normal to axis a, index i being the low face of cell i.
struct FaceField {
  int id = -1;
};

/// Rows in the order of declaration. A face field takes DIM consecutive arrays.
class FieldTable {
 public:
  CellField add_cell(FieldSpec spec) {
    spec.centring = Centring::cell;
    return {append(std::move(spec))};
  }
  FaceField add_face(const FieldSpec& spec) {
    FaceField f;
    for (int a = 0; a < DIM; ++a) {
      FieldSpec component = spec;
      component.centring = Centring::face;
      component.normal = a;
      component.name += std::string("_") + "xyz"[a];
      const int id = append(std::move(component));
      if (a == 0) f.id = id;
    }
    return f;
  }
  std::optional<int> find(const std::string& name) const {
    for (int i = 0; i < size(); ++i)
      if (row(i).name == name) return i;
    return std::nullopt;
  }
  int size() const { return static_cast<int>(rows_.size()); }
  const FieldSpec& row(int id) const { return rows_[static_cast<std::size_t>(id)]; }

  /// Arrays that live through a change of the mesh.
  std::vector<int> transferred() const {
    std::vector<int> out;
    for (int i = 0; i < size(); ++i)
      if (row(i).transfer != Transfer::none) out.push_back(i);
    return out;
  }
  /// The cell-centred ones among them.
  std::vector<CellField> transferred_cells() const {
    std::vector<CellField> out;
    for (const int i : transferred())
      if (row(i).centring == Centring::cell) out.push_back({i});
    return out;
  }
  /// Values of a row that a block of n cells a side keeps: its cells, or its faces on both sides.
  IntVec extent(int id, int n) const {
    IntVec e = filled(n);
    if (row(id).normal >= 0) ++e[row(id).normal];
    return e;
  }

 private:
  int append(FieldSpec spec) {
    if (find(spec.name)) throw std::logic_error("field declared twice: " + spec.name);
    rows_.push_back(std::move(spec));
    return size() - 1;
  }
  std::vector<FieldSpec> rows_;
};

}  // namespace dendrift::amr

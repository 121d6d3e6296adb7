/// \file
/// Rotations of rigid solids, which multigrid does not see: a second level of the preconditioner.
#pragma once

#include <array>
#include <vector>

#include "amr/hierarchy.hpp"
#include "physics/whirls.hpp"

namespace dendrift::physics {

/// One velocity Z a whirl and axis, free of divergence: rigid rotation within the hull, and outside flow that comes to rest at
/// the reach. With T, the products with Z, what a force r turns is c = (T K Z)^-1 T r. Whirls may overlap; where they do, a face
/// belongs to the one that reaches farther beyond it.
class TurningModes {
 public:
  static constexpr int AXES = DIM == 2 ? 1 : 3;

  /// `velocities`: the first components of all fields that are handed over later.
  void build(const amr::Hierarchy& hierarchy, const std::vector<amr::Component>& velocities,
             const std::vector<Whirl>& whirls);
  bool empty() const { return inverse_.empty(); }

  /// v = the unit rotations of all whirls about an axis, on the leaves.
  void write(int axis, amr::HierarchyField& v) const;
  /// K Z on the leaves, Z of write(axis).
  void take_image(int axis, const amr::HierarchyField& image);
  /// After the images of all axes. Collective.
  void prepare();

  /// r -= K Z c. Collective, the same on any ranks.
  void take_from(amr::HierarchyField& r);
  /// v += Z c, c of the last take_from.
  void add_to(amr::HierarchyField& v) const;

 private:
  using Axes = std::array<double, AXES>;
  struct Face {
    std::ptrdiff_t place;
    int axis, whirl;
    double volume;
    Axes mode, image;
  };
  template <class F>
  std::vector<double> sums(std::size_t width, F&& f) const;

  const amr::Hierarchy* hierarchy_ = nullptr;
  std::vector<std::vector<Face>> faces_;  // by local block
  std::vector<std::array<double, std::size_t{AXES} * AXES>> inverse_;  // of each whirl's T K Z
  std::vector<Axes> turns_;
};

}  // namespace dendrift::physics

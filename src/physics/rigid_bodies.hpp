/// \file
/// Solids that resist only what is not rigid: for each, the rigid motion that its drag on the melt leaves without net
/// force and torque.
#pragma once

#include <array>
#include <functional>
#include <vector>

#include "amr/hierarchy.hpp"

namespace dendrift::physics {

/// Velocity of the reference point, then the rates of rotation (2D: one).
inline constexpr int RIGID = DIM == 2 ? 3 : 6;
using RigidMotion = std::array<double, RIGID>;

/// Faces of the leaves that belong to bodies, and the least-squares fit of rigid motions to a velocity, weighted with the
/// drag: what is left exerts no force and no torque.
class RigidBodies {
 public:
  /// Whose the cells are: label(b) points at cell (0,0[,0]) of an array of labels, body[label] is the body or HELD. Without
  /// labels a face belongs to the nearest centre.
  struct Owners {
    std::function<const double*(int b)> label;
    std::vector<int> body;
  };
  static constexpr int HELD = -1;  ///< no motion of its own: 0
  /// `drag`: on the faces of all leaves. Collective.
  void build(const amr::Hierarchy& hierarchy, const amr::HierarchyField& drag, const std::vector<RealVec>& centres,
             const Owners& owners);
  bool empty() const { return motions_.empty(); }

  /// The motions that fit v best; kept until the next fit. Collective, the same on any ranks.
  void fit(const amr::HierarchyField& v);
  /// y -= drag * rigid velocity on the faces of local block b.
  void subtract(int b, amr::HierarchyField& y) const;
  const std::vector<RigidMotion>& motions() const { return motions_; }

 private:
  struct Face {
    std::ptrdiff_t place;
    int axis, body;
    double drag, volume;
    RealVec arm;  // from the body's centre
  };
  static RigidMotion mode(const Face& f);

  const amr::Hierarchy* hierarchy_ = nullptr;
  std::vector<std::vector<Face>> faces_;  // by local block
  std::vector<std::array<double, std::size_t{RIGID} * RIGID>> inverse_;  // of each body's matrix of moments
  std::vector<RigidMotion> motions_;
};

}  // namespace dendrift::physics

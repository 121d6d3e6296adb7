/// \file
/// Where the crystals are and how they point: what tips are measured against.
#pragma once

#include <mpi.h>

#include <vector>

#include "amr/mesh.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// One arm of one crystal. Lengths in W0, from the crystal's centre; the arm grows along a crystal axis.
struct Tip {
  int grain = 0;
  int arm = 0;            ///< 2 * axis, + 1 along the negative axis
  RealVec direction{};
  RealVec position{};     ///< of phi = 0 on the arm's axis
  double length = 0;      ///< distance from the centre; 0: no solid on the axis
  double off_axis_deg = 0;  ///< 2D: angle by which the apex of that parabola lies off the axis, counterclockwise
  double radius = 0;      ///< of the parabola (the mean of two in 3D) through phi = 0 within TIP_WINDOW of the axis
};

/// Half width, in W0, of the window in which a parabola is fitted to a tip.
inline constexpr double TIP_WINDOW = 3.0;

/// Tips of all crystals whose arms lie in the box. psi's ghosts must be filled. Collective; the same on all ranks
/// and whatever their number.
std::vector<Tip> find_tips(const amr::Mesh& mesh, amr::CellField psi, const std::vector<Seed>& crystals);

}  // namespace dendrift::physics

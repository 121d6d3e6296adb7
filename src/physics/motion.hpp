/// \file
/// How the crystals move: read off the velocity inside them, never integrated over their surfaces.
#pragma once

#include <functional>
#include <vector>

#include "amr/mesh.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// Sets velocity, spin, volume and nonrigidity of each crystal: the rigid motion that fits the velocity of its core
/// (phi > .9) best, by least squares. Without a velocity (id -1) nothing moves. `grain`: whose a cell is; without it (id -1) that
/// of the nearest centre. Collective; the same on all ranks and whatever their number.
void measure_motion(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, amr::FaceField velocity,
                    std::vector<Seed>& crystals);

/// r x f; in 2D the last component.
std::array<double, 3> moment(const RealVec& r, const RealVec& f);

/// Net force and torque about the centre (2D: the last component), over the density of the melt.
struct Load {
  RealVec force{};
  std::array<double, 3> torque{};
};

/// Load on each crystal and the interface round it (phi > -.99), of a force per mass on faces: force(b, axis) points
/// at cell (0,0[,0]) of local block b. Collective, the same on any ranks.
std::vector<Load> net_loads(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals,
                                const std::function<const double*(int b, int axis)>& force);

/// Whose the cell at x is, cell number `cell` of local block b.
std::size_t crystal_of(const amr::Mesh& mesh, amr::CellField grain, const std::vector<Seed>& crystals, const RealVec& x, int b,
                       std::ptrdiff_t cell);

}  // namespace dendrift::physics

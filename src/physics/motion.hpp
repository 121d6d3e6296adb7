/// \file
/// How the crystals move: read off the velocity inside them, never integrated over their surfaces.
#pragma once

#include <vector>

#include "amr/mesh.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// Sets velocity, spin, volume and nonrigidity of each crystal: the rigid motion that fits the velocity of its core
/// (phi > .9) best, by least squares. Without a velocity (id -1) nothing moves. The solid nearest to a crystal's centre counts as its own. Collective; the same on all
/// ranks and whatever their number.
void measure_motion(const amr::Mesh& mesh, amr::CellField psi, amr::FaceField velocity, std::vector<Seed>& crystals);

}  // namespace dendrift::physics

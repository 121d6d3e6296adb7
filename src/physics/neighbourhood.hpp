/// \file
/// Where crystals stand: to each other, to the walls, and in the melt that moves with them.
#pragma once

#include <vector>

#include "amr/mesh.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// Corners of a block's cells, one more layer than the block has.
struct Corners {
  int n;  ///< cells along an axis
  int pitch() const { return n + 3; }
  std::size_t count() const { return static_cast<std::size_t>(volume(filled(pitch()))); }
  std::ptrdiff_t stride(int axis) const {
    std::ptrdiff_t s = 1;
    for (int a = 0; a < axis; ++a) s *= pitch();
    return s;
  }
  /// Of the low corner of cell q, -1 <= q <= n + 1.
  std::ptrdiff_t offset(const IntVec& q) const {
    std::ptrdiff_t o = 0;
    for (int a = DIM - 1; a >= 0; --a) o = o * pitch() + q[a] + 1;
    return o;
  }
};

struct Neighbourhood {
  /// All lengths in W0.
  struct Crystal {
    RealVec centre{};
    double radius = 0;  ///< of its farthest point; 0: it is not there
    double gap = 0;     ///< to the next crystal or wall
  };
  std::vector<Crystal> crystals;
  /// Of each crystal: the first of those that it is frozen to, directly or through others, and itself; or FIXED, to a wall.
  std::vector<int> body;
  static constexpr int FIXED = -1;

  /// How far the melt goes along with a crystal: 1 in the crystal, 0 in others, on walls and two radii away, smooth between
  /// them. Where others are near, the parts of all add up to 1.
  struct Share {
    int crystal;
    std::vector<double> part;  ///< at Corners
  };
  std::vector<std::vector<Share>> shares;  ///< by local block
};

/// psi: signed distance from the interface over W0, ghosts filled. `grain`: whose a cell is; without it (id -1) that of the
/// nearest centre. Collective, the same on any ranks.
Neighbourhood find_neighbourhood(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals);

}  // namespace dendrift::physics

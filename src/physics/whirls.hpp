/// \file
/// Solids that may turn on their own, and the melt round each that its rotation may stir.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "amr/mesh.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// Functions of direction: values at the nodes of a grid on the surface of a square (cube) round the origin, linear in
/// between and continuous over its corners.
class Directions {
 public:
  static const std::vector<RealVec>& nodes();  ///< as unit vectors
  /// Calls f(node, weight) for the nodes that a value in the direction of r depends on. r is not 0.
  template <class F>
  static void around(const RealVec& r, F&& f);
  static double value(const std::vector<double>& at_nodes, const RealVec& r);
};

/// A star-shaped hull of a solid, and how far melt is stirred; both distances from a centre, by direction (see Directions).
struct Whirl {
  RealVec centre{};
  std::vector<double> radius, reach;

  static Whirl round(const RealVec& centre, double radius, double reach);
};

/// How crystals stand to each other and to the walls.
struct Neighbourhood {
  /// Of all crystals that are there: the hull holds what is stiffer than melt, as a circle (sphere) where others leave room,
  /// and melt is stirred half way to the next crystal, to a wall, or as far as four radii.
  std::vector<Whirl> whirls;
  /// Of each crystal: the first of those that it is frozen to, directly or through others, and itself; or FIXED, to a wall.
  std::vector<int> body;
  static constexpr int FIXED = -1;
};

/// `grain`: whose a cell is; without it (id -1) that of the nearest centre. Collective, the same on any ranks.
Neighbourhood find_neighbourhood(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals);

// Implementation

namespace detail {
inline constexpr int DIRECTION_CELLS = DIM == 2 ? 24 : 12;  // along an edge of the square (cube)
int direction_node(const IntVec& place);                    // of the grid's places, 0 to DIRECTION_CELLS along each axis
}  // namespace detail

template <class F>
void Directions::around(const RealVec& r, F&& f) {
  double most = 0;
  for (const double x : r) most = std::max(most, std::abs(x));
  IntVec low{};
  RealVec beyond{};
  for (int a = 0; a < DIM; ++a) {
    const double t = 0.5 * (r[a] / most + 1) * detail::DIRECTION_CELLS;
    low[a] = std::min(static_cast<int>(t), detail::DIRECTION_CELLS - 1);
    beyond[a] = t - low[a];
  }
  for (int corner = 0; corner < 1 << DIM; ++corner) {
    double weight = 1;
    IntVec place = low;
    for (int a = 0; a < DIM; ++a) {
      const bool high = (corner >> a & 1) != 0;
      weight *= high ? beyond[a] : 1 - beyond[a];
      place[a] += high ? 1 : 0;
    }
    if (weight > 0) f(detail::direction_node(place), weight);
  }
}

}  // namespace dendrift::physics

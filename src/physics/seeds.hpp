/// \file
/// The crystals at the start: table [[seed]].
#pragma once

#include <array>
#include <optional>
#include <span>
#include <vector>

#include "amr/mesh.hpp"
#include "io/config.hpp"
#include "physics/scales.hpp"

namespace dendrift::physics {

/// As written in the input; every length in um or in W0.
struct SeedOptions {
  std::optional<RealVec> position_um, position_w0;
  std::optional<double> radius_um, radius_w0, inner_radius_um, inner_radius_w0;
  double aspect_ratio = 1;
  double angle_deg = 0;
  std::array<double, 3> euler_deg{};
  std::optional<double> nucleation_time_s, nucleation_time_tau0;
  bool held = false;

  static void declare(io::Schema& schema, std::vector<SeedOptions>& seeds);
};

/// A crystal: as it starts, and how it moves.
struct Seed {
  RealVec position{};     ///< of the point where it started, which moves with it, W0
  double radius = 0;      ///< at the start, W0: of the disc (sphere) of the same size
  double inner_radius = 0;  ///< at the start, W0: of the hole of a ring (shell); 0: none
  double aspect_ratio = 1;  ///< at the start: semi-axis along crystal axis 0 over the others
  Array<RealVec> axes{};  ///< row i: crystal axis i in the frame of the mesh
  bool rotated = false;   ///< axes are not those of the mesh
  RealVec velocity{};     ///< of that point, W0/tau0
  std::array<double, 3> spin{};  ///< rad/tau0; 2D: the last one
  double angle = 0;       ///< 2D: of axis 0, unwrapped, rad
  double volume = 0;      ///< 2D: area; measured with the motion
  double nucleation_time = 0;  ///< tau0
  bool held = false;      ///< by a resistance, in its place
  bool present = true;    ///< has nucleated
  bool refused = false;   ///< and never will: there was no undercooled melt
  int contacts = 0;       ///< crystals that it touches
  bool touching = false;  ///< another crystal touches it: its cells have angles of their own, eq. (4)
  double nonrigidity = 0; ///< rms deviation of the solid's velocity from rigid motion, over its rms velocity

  /// Moves and turns for a time dt.
  void advance(double dt);
  /// 2D: turns on the spot, counterclockwise.
  void turn(double by);
  /// Semi-axes at the start, along crystal axis 0 and across it.
  std::array<double, 2> semi_axes() const;
  /// Distance from the surface at the start, positive inside; r: place relative to the centre.
  double depth(const RealVec& r) const;
};

/// Crystals among which, of those that are there, the one with the largest Seed::depth is, for every place in a ball.
std::vector<std::size_t> deepest(const std::vector<Seed>& crystals, const amr::MeshShape& shape, const RealVec& middle, double radius);

/// Whether crystals may have several orientations at some time: they start with several, or may turn.
bool several_orientations(const std::vector<Seed>& crystals, bool turning);

/// Unit quaternion (real part first, >= 0) that turns the axes of the mesh into those of the crystal.
std::array<double, 4> quaternion(const Seed& crystal);

/// What a restart must know of a crystal, and giving it back. Throws std::out_of_range if the list is too short.
std::vector<double> memory(const Seed& crystal);
void recall(Seed& crystal, std::span<const double> memory);

std::vector<Seed> make_seeds(const std::vector<SeedOptions>& options, const Scales& scales);

}  // namespace dendrift::physics

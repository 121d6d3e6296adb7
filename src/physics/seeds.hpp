/// \file
/// The crystals at the start: table [[seed]].
#pragma once

#include <optional>
#include <vector>

#include "amr/dim.hpp"
#include "io/config.hpp"
#include "physics/scales.hpp"

namespace dendrift::physics {

/// As written in the input; every length in um or in W0.
struct SeedOptions {
  std::optional<RealVec> position_um, position_w0;
  std::optional<double> radius_um, radius_w0;
  double angle_deg = 0;
  std::array<double, 3> euler_deg{};

  static void declare(io::Schema& schema, std::vector<SeedOptions>& seeds);
};

struct Seed {
  RealVec position{};     ///< W0
  double radius = 0;      ///< W0
  Array<RealVec> axes{};  ///< row i: crystal axis i in the frame of the mesh
  bool rotated = false;
};

std::vector<Seed> make_seeds(const std::vector<SeedOptions>& options, const Scales& scales);

}  // namespace dendrift::physics

/// \file
/// Crystals by the dozen: table [seeds], at random or from a file.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "amr/mesh.hpp"
#include "io/config.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// What is wrong with a file of seeds, or why seeds have no room.
struct SeedingProblem : std::runtime_error {
  SeedingProblem(std::string key_of_input, std::string what_was_expected, std::string what_was_found)
      : std::runtime_error(what_was_expected), key(std::move(key_of_input)), expected(std::move(what_was_expected)),
        found(std::move(what_was_found)) {}
  std::string key, expected, found;
};

struct SeedingOptions {
  int count = 0;
  std::int64_t generator = 1;
  std::optional<double> radius_um, radius_w0;
  double clearance_w0 = 20;
  RealVec region_lo{}, region_hi = filled_real(1);
  std::optional<double> last_time_s, last_time_tau0;
  std::string file;

  void declare(io::Schema& schema);

  /// Seeds at random places with random orientations: uniform in the region, no closer to each other (surface to surface) and
  /// to the sides than the clearance; nucleation times uniform up to the last. Throws SeedingProblem if there is no room.
  std::vector<SeedOptions> at_random(const amr::MeshShape& shape, const Scales& scales) const;
  /// Rows of a CSV file with a header: x_um, y_um[, z_um], radius_um, and as wanted angle_deg (2D), euler1_deg, euler2_deg,
  /// euler3_deg (3D), nucleation_time_s, held. W0 and tau0 in place of um and s are understood. Relative to `folder`.
  std::vector<SeedOptions> from_file(const std::string& folder, const Scales& scales) const;

 private:
  static constexpr RealVec filled_real(double x) {
    RealVec v{};
    for (double& e : v) e = x;
    return v;
  }
};

}  // namespace dendrift::physics

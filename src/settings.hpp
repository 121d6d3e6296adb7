/// \file
/// Everything an input file can say, gathered; and the numbers that follow from it.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "amr/mesh.hpp"
#include "amr/partition.hpp"
#include "io/config.hpp"
#include "physics/flow.hpp"
#include "physics/orientation.hpp"
#include "physics/phase_field.hpp"
#include "physics/scales.hpp"
#include "physics/seeding.hpp"
#include "physics/seeds.hpp"
#include "physics/solute.hpp"

namespace dendrift {

struct RunOptions {
  std::string title;
  std::optional<double> end_time_s, end_time_tau0;
  std::int64_t max_steps = 1'000'000'000;
  double wall_clock_limit_s = 0;

  void declare(io::Schema& schema);
};

struct MeshOptions {
  int dim = 2;
  std::optional<RealVec> size_um, size_w0;
  double dx_w0 = 1.0;
  int block_cells = 16;
  std::optional<IntVec> root_blocks;
  std::optional<int> levels;
  std::array<amr::Side, 6> sides{};  ///< those of z are read in 3D only
  int max_regrid_steps = 50;

  void declare(io::Schema& schema);
};

struct ParallelOptions {
  amr::Partitioner partitioner = amr::Partitioner::curve;
  double max_imbalance = 1.1;

  void declare(io::Schema& schema);
};

struct OutputOptions {
  std::string dir = "out";
  std::optional<double> plot_every_s, plot_every_tau0;
  std::optional<double> diagnostics_every_s, diagnostics_every_tau0;
  double checkpoint_every_s = 0;
  std::int64_t checkpoint_every_steps = 0;
  double checkpoint_every_wall_s = 0;
  int keep_checkpoints = 2;

  void declare(io::Schema& schema);
};

inline constexpr std::int64_t MOST_ROOT_BLOCKS = 1'000'000;

/// Declares every table on construction; parse() binds them. Throws io::InputError.
class Settings {
 public:
  Settings();
  Settings(const Settings&) = delete;
  Settings& operator=(const Settings&) = delete;

  void parse(const std::string& path, const std::vector<std::string>& overrides);
  void parse_text(const std::string& toml, const std::string& name, const std::vector<std::string>& overrides);

  RunOptions run;
  MeshOptions mesh;
  ParallelOptions parallel;
  OutputOptions output;
  physics::AlloyOptions alloy;
  physics::PhaseFieldOptions phase_field;
  physics::SoluteOptions solute;
  physics::OrientationOptions orientation;
  physics::FlowOptions flow;
  std::vector<physics::SeedOptions> seed;
  physics::SeedingOptions seeding;
  io::Schema schema;

  // Derived; valid after parse.
  std::vector<physics::Seed> crystals;  ///< of [[seed]], then those of [seeds]: from the file, at random
  physics::Scales scales;
  amr::MeshShape shape;
  double end_time = 0;              ///< tau0
  double plot_interval = 0;         ///< tau0; 0: only the last state
  double diagnostics_interval = 0;  ///< tau0
  /// Of the text of the file of seeds, if there is one.
  std::optional<std::uint32_t> seeds_checksum() const { return seeds_checksum_; }
  bool has_flow() const { return schema.has_table("flow"); }

 private:
  void derive();
  std::vector<physics::SeedOptions> all_seeds(const amr::MeshShape& shape, const physics::Scales& s) const;
  std::string folder_;  // of the input file
  std::optional<std::uint32_t> seeds_checksum_;
};

/// Root blocks and levels whose finest cubic cells do not exceed dx: few root blocks under a deep tree, as long as the
/// cells are not much smaller than dx (7 %; 20 or 40 % where only that gives three levels).
/// Throws std::invalid_argument with the reason if the box cannot be tiled.
amr::MeshShape choose_shape(const RealVec& size, const MeshOptions& options);

}  // namespace dendrift

/// \file
/// manifest.json: which program computed what, where, and how long it took.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>

namespace dendrift::io {

struct Manifest {
  std::string status;   ///< running, done, stopped, failed
  std::optional<int> exit_code;  ///< none while it runs
  std::string message;  ///< why it failed
  std::string started;  ///< ISO 8601
  int ranks = 1;
  std::string input;  ///< resolved, TOML
  double time_s = 0;
  std::int64_t steps = 0;
  double wall_s = 0;
  std::map<std::string, double> phases;  ///< wall seconds, mean over ranks
  std::int64_t blocks = 0;
  int block_cells = 0;
};

/// Rewritten under a temporary name and renamed. One rank calls it; throws OutputError.
void write_manifest(const std::string& path, const Manifest& m);

/// Now, UTC, ISO 8601.
std::string time_stamp();

/// Version, git hash, compiler and flags, a few lines for --version.
std::string version_text();

}  // namespace dendrift::io

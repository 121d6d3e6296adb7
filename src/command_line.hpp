/// \file
/// Arguments of the program.
#pragma once

#include <optional>
#include <string>
#include <vector>

namespace dendrift {

struct CommandLine {
  std::string input;
  std::vector<std::string> overrides;  ///< section.key=value
  std::string restart;
  bool allow_changes = false;  ///< a restart may change physics
  bool check = false, keys = false, markdown = false;
  std::optional<int> exit_code;  ///< nothing left to do: --help, --version, a usage error (2)
};

/// Prints help, version and usage errors if `print`.
CommandLine parse_command_line(int argc, char** argv, bool print);

}  // namespace dendrift

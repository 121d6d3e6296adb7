/// \file
/// How the input's values, keys and mistakes are put into words; shared by the sources of config.hpp alone.
#pragma once

#include <limits>
#include <string>
#include <vector>

#include "io/config.hpp"

namespace dendrift::io::detail {

inline constexpr const char* command_line = "command line";
// Order of the issues that belong to no line of the file.
inline constexpr std::size_t after_lines = std::numeric_limits<std::size_t>::max() - 1;
inline constexpr std::size_t after_file = std::numeric_limits<std::size_t>::max();

bool is_bare(const std::string& name);                        ///< a key that TOML takes without quotes
std::string clip(const std::string& text, std::size_t size);  ///< shortens without cutting a UTF-8 sequence
std::string trim(const std::string& text);

// Values as TOML.
std::string literal(bool value);
std::string literal(std::int64_t value);
std::string literal(double value);
std::string literal(const std::string& value);
std::string literal(const KeySpec& spec, const Items& items);
std::string shown(const std::string& name);

// What a key accepts.
bool accepts(const KeySpec& spec, const Item& item);
std::string range_text(const KeySpec& spec);
std::string type_text(const KeySpec& spec, const std::string& noun);  ///< "real", "3 reals", "list of reals"
std::string expected_text(const KeySpec& spec);

/// A hint at the known word most like `word`; empty when none is.
std::string suggestion(const std::string& word, const std::vector<std::string>& known);

}  // namespace dendrift::io::detail

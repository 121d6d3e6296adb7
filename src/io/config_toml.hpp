/// \file
/// Reading TOML so that no input can upset the program; shared by the sources of config.hpp alone.
#pragma once

#include <cstddef>
#include <string>

// Numbers are read exactly and whatever the locale; the depth bounds the recursion over the tree; toml++ 3.3
// asserts what it checks again just after, on headers such as [.a].
#define TOML_ENABLE_FORMATTERS 0
#define TOML_ASSERT(condition) static_cast<void>(0)
#define TOML_FLOAT_CHARCONV 1
#define TOML_MAX_NESTED_VALUES 16
#include <toml++/toml.h>

namespace dendrift::io::detail {

/// Input that cannot be read as TOML at all.
struct Broken {
  std::size_t line;  // 0: none
  std::string expected, found;
};

/// The tree of a text; `name` is what its nodes say about where they come from. Throws Broken.
toml::table read_toml(const std::string& text, const std::string& name);

/// The text of an input file. Throws Broken.
std::string read_file(const std::string& path);

}  // namespace dendrift::io::detail

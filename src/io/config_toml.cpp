#include "io/config_toml.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <fstream>
#include <string_view>
#include <system_error>
#include <vector>

#include "io/config_text.hpp"

namespace dendrift::io::detail {

namespace {

constexpr std::size_t max_file_bytes = std::size_t{16} << 20;
constexpr std::size_t max_dotted_parts = 32;

std::size_t line_at(std::string_view text, std::size_t i) {
  return 1 + static_cast<std::size_t>(std::ranges::count(text.substr(0, i), '\n'));
}

void require_ascii(std::string_view text, std::size_t i, const char* expected) {
  const auto byte = i < text.size() ? static_cast<unsigned char>(text[i]) : 0u;
  if (byte < 0x80) return;
  throw Broken{line_at(text, i), expected,
               fmt::format("byte 0x{:X} (perhaps a typographic quote or space)", byte)};
}

/// The last character of the string that opens at `i`.
std::size_t string_end(std::string_view text, std::size_t i) {
  const char quote = text[i];
  const std::size_t width = text.substr(i, 3) == std::string(3, quote) ? 3 : 1;
  for (i += width; i < text.size(); ++i) {
    if (width == 1 && text[i] == '\n') return i - 1;
    if (quote == '"' && text[i] == '\\') {
      const std::size_t next = text.find_first_not_of(" \t\r\n", ++i);
      if (width == 3 && next != i) require_ascii(text, next, "only ASCII right after a broken line");
    } else if (text.substr(i, width) == std::string(width, quote)) {
      i += width - 1;
      for (int own = 0; width == 3 && own < 2 && i + 1 < text.size() && text[i + 1] == quote; ++own) ++i;
      return i;  // a long string may end in up to two quotes of its own
    }
  }
  return text.size();
}

/// Rejects what would bring toml++ 3.3 down: dotted keys so long that recursing over their tables exhausts
/// the stack, and non-ASCII where it asks whether a character is a space, which is undefined for most of
/// Unicode.
void reject_hazards(std::string_view text) {
  std::size_t parts = 1;
  for (std::size_t i = text.starts_with("\xEF\xBB\xBF") ? 3 : 0; i < text.size(); ++i) {
    require_ascii(text, i, "only ASCII outside texts and comments");
    if (text[i] == '#') i = std::min(text.find('\n', i), text.size() - 1);
    if (text[i] == '"' || text[i] == '\'') {
      i = string_end(text, i);
    } else if (text[i] == '.' && ++parts > max_dotted_parts) {
      throw Broken{line_at(text, i), fmt::format("at most {} parts in a dotted key", max_dotted_parts),
                   "more"};
    } else if (std::string_view("\n=,[]{}").find(text[i]) != std::string_view::npos) {
      parts = 1;
    }
  }
}

}  // namespace

toml::table read_toml(const std::string& text, const std::string& name) {
  if (const auto nul = text.find('\0'); nul != std::string::npos)
    throw Broken{line_at(text, nul), "a text file in UTF-8", "a NUL byte (a binary file?)"};
  reject_hazards(text);
  try {
    return toml::parse(std::string_view(text), std::string_view(name));
  } catch (const toml::parse_error& error) {
    std::string found = clip(std::string(error.description()), 300);
    std::ranges::replace_if(
        found, [](unsigned char c) { return c < 0x20 || c == 0x7F; }, '?');
    throw Broken{error.source().begin.line, "valid TOML", found};
  }
}

std::string read_file(const std::string& path) {
  std::error_code ignored;
  if (std::filesystem::is_directory(path, ignored)) throw Broken{0, "a file", "a folder"};
  std::ifstream in(path, std::ios::binary);
  if (!in) throw Broken{0, "a readable file", std::generic_category().message(errno)};
  std::string text;
  std::vector<char> block(std::size_t{1} << 16);
  while (in.read(block.data(), static_cast<std::streamsize>(block.size())), in.gcount() > 0) {
    text.append(block.data(), static_cast<std::size_t>(in.gcount()));
    if (text.size() > max_file_bytes)
      throw Broken{0, fmt::format("at most {} bytes", max_file_bytes), "more (not an input file?)"};
  }
  if (in.bad()) throw Broken{0, "a readable file", "a read error"};
  if (trim(text).empty()) throw Broken{0, "at least one [table]", "an empty file"};
  return text;
}

}  // namespace dendrift::io::detail

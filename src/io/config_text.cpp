#include "io/config_text.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cctype>
#include <cmath>

namespace dendrift::io::detail {

namespace {

bool within(const KeySpec& spec, double x) {
  return (spec.low_open ? x > spec.low : x >= spec.low) && (spec.high_open ? x < spec.high : x <= spec.high);
}

int lower(char c) { return std::tolower(static_cast<unsigned char>(c)); }

std::size_t edit_distance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = std::exchange(row[0], i);
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t replaced = diagonal + (lower(a[i - 1]) == lower(b[j - 1]) ? 0 : 1);
      diagonal = std::exchange(row[j], std::min({replaced, row[j] + 1, row[j - 1] + 1}));
    }
  }
  return row.back();
}

}  // namespace

bool is_bare(const std::string& name) {
  return !name.empty() && std::ranges::all_of(name, [](unsigned char c) {
    return c < 0x80 && (std::isalnum(c) || c == '_' || c == '-');
  });
}

std::string clip(const std::string& text, std::size_t size) {
  if (text.size() <= size) return text;
  while (size > 0 && (static_cast<unsigned char>(text[size]) & 0xC0) == 0x80) --size;
  return text.substr(0, size) + "...";
}

std::string trim(const std::string& text) {
  const auto first = text.find_first_not_of(" \t\r\n");
  return first == std::string::npos ? "" : text.substr(first, text.find_last_not_of(" \t\r\n") - first + 1);
}

// ---- values as TOML ----

std::string literal(bool value) { return value ? "true" : "false"; }
std::string literal(std::int64_t value) { return fmt::format("{}", value); }

std::string literal(double value) {
  std::string text = fmt::format("{}", value);  // shortest that reads back to the same bits
  if (text.find_first_of(".enif") == std::string::npos) text += ".0";
  return text;
}

std::string literal(const std::string& value) {
  std::string text = "\"";
  for (const char c : value) {
    if (static_cast<unsigned char>(c) < 0x20 || c == 0x7F) {
      text += fmt::format("\\u{:04X}", static_cast<unsigned>(c));
    } else {
      if (c == '"' || c == '\\') text += '\\';
      text += c;
    }
  }
  return text + '"';
}

std::string literal(const KeySpec& spec, const Items& items) {
  std::vector<std::string> texts;
  for (const Item& item : items)
    texts.push_back(std::visit([](const auto& value) { return literal(value); }, item));
  return spec.list ? fmt::format("[{}]", fmt::join(texts, ", ")) : texts.front();
}

std::string shown(const std::string& name) {
  return is_bare(name) ? clip(name, 80) : literal(clip(name, 80));
}

// ---- what a key accepts ----

bool accepts(const KeySpec& spec, const Item& item) {
  if (const auto* value = std::get_if<std::int64_t>(&item))
    return *value >= spec.smallest && *value <= spec.largest && within(spec, static_cast<double>(*value));
  if (const auto* value = std::get_if<double>(&item))
    return (std::isfinite(*value) || (spec.infinite && std::isinf(*value))) && within(spec, *value);
  if (spec.kind != Kind::choice) return true;
  return std::ranges::find(spec.choices, std::get<std::string>(item)) != spec.choices.end();
}

std::string range_text(const KeySpec& spec) {
  const bool low = std::isfinite(spec.low), high = std::isfinite(spec.high);
  const char open = spec.low_open ? '(' : '[', close = spec.high_open ? ')' : ']';
  if (low && high) return fmt::format("in {}{}, {}{}", open, spec.low, spec.high, close);
  if (low) return fmt::format("{} {}", spec.low_open ? ">" : ">=", spec.low);
  return high ? fmt::format("{} {}", spec.high_open ? "<" : "<=", spec.high) : "";
}

std::string type_text(const KeySpec& spec, const std::string& noun) {
  if (!spec.list) return noun;
  return spec.length > 0 ? fmt::format("{} {}s", spec.length, noun) : fmt::format("list of {}s", noun);
}

std::string expected_text(const KeySpec& spec) {
  if (spec.kind == Kind::choice) return fmt::format("one of {}", fmt::join(spec.choices, ", "));
  static constexpr std::array nouns{"finite real number", "integer", "true or false", "text"};
  const std::string noun = spec.infinite ? "real number" : nouns[static_cast<std::size_t>(spec.kind)];
  std::string text = (spec.length > 0 ? "list of " : "") + type_text(spec, noun);
  const std::string range = range_text(spec);
  if (!range.empty()) text += (spec.list ? ", each " : " ") + range;
  if (!spec.unit.empty()) text += (range.empty() ? " in " : " ") + spec.unit;
  return text;
}

// ---- suggestions ----

std::string suggestion(const std::string& word, const std::vector<std::string>& known) {
  std::string best;
  std::size_t best_distance = std::numeric_limits<std::size_t>::max();
  for (const std::string& candidate : known) {
    const auto [shorter, longer] = std::minmax({word.size(), candidate.size()});
    const std::size_t limit = longer / 3 + 1;
    if (longer - shorter > limit) continue;  // also keeps a huge word from costing anything
    const std::size_t distance = edit_distance(word, candidate);
    if (distance > limit || distance >= best_distance) continue;
    best = candidate;
    best_distance = distance;
  }
  return best.empty() ? "" : fmt::format("did you mean {}?", best);
}

}  // namespace dendrift::io::detail

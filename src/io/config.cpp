#include "io/config.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cctype>
#include <cerrno>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <string_view>
#include <system_error>

// Numbers are read exactly and whatever the locale; the depth bounds the recursion over the tree; toml++ 3.3
// asserts what it checks again just after, on headers such as [.a].
#define TOML_ENABLE_FORMATTERS 0
#define TOML_ASSERT(condition) static_cast<void>(0)
#define TOML_FLOAT_CHARCONV 1
#define TOML_MAX_NESTED_VALUES 16
#include <toml++/toml.h>

namespace dendrift::io {
namespace {

constexpr std::size_t max_file_bytes = std::size_t{16} << 20;
constexpr std::size_t max_dotted_parts = 32;
constexpr std::size_t max_issues_printed = 100;
constexpr std::size_t after_lines =
    std::numeric_limits<std::size_t>::max() - 1;  // order of whole-file issues
constexpr std::size_t after_file = std::numeric_limits<std::size_t>::max();
const char* const command_line = "command line";

/// Input that cannot be read as TOML at all.
struct Broken {
  std::size_t line;  // 0: none
  std::string expected, found;
};

bool is_bare(const std::string& name) {
  return !name.empty() && std::ranges::all_of(name, [](unsigned char c) {
    return c < 0x80 && (std::isalnum(c) || c == '_' || c == '-');
  });
}

/// Shortens without cutting a UTF-8 sequence.
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

bool within(const KeySpec& spec, double x) {
  return (spec.low_open ? x > spec.low : x >= spec.low) && (spec.high_open ? x < spec.high : x <= spec.high);
}

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

/// "real", "3 reals", "list of reals"
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

/// A hint at the known word most like `word`; empty when none is.
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

// ---- reading TOML ----

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

std::string describe(const toml::node& node) {
  if (const auto* text = node.as_string()) return "text " + literal(clip(text->get(), 60));
  if (const auto* integer = node.as_integer()) return "integer " + literal(integer->get());
  if (const auto* real = node.as_floating_point()) return "real number " + literal(real->get());
  if (const auto* boolean = node.as_boolean()) return literal(boolean->get());
  if (const auto* list = node.as_array()) return fmt::format("a list of {}", list->size());
  return node.is_table() ? "a table" : "a date or time";
}

std::optional<Item> read_scalar(Kind kind, const toml::node& node) {
  if (kind == Kind::boolean && node.is_boolean()) return node.as_boolean()->get();
  if ((kind == Kind::text || kind == Kind::choice) && node.is_string()) return node.as_string()->get();
  if (kind == Kind::integer && node.is_integer()) return node.as_integer()->get();
  if (kind == Kind::real && node.is_integer()) return static_cast<double>(node.as_integer()->get());
  if (kind == Kind::real && node.is_floating_point()) return node.as_floating_point()->get();
  return {};
}

struct Override {
  std::string section, key, value;
  std::optional<std::size_t> index;
};

std::optional<Override> split_override(const std::string& text) {
  const auto equals = text.find('=');
  const std::string path = trim(text.substr(0, equals));
  const auto dot = path.find('.');
  if (equals == std::string::npos || dot == std::string::npos) return {};
  Override result{path.substr(0, dot), path.substr(dot + 1), trim(text.substr(equals + 1)), {}};
  if (const auto open = result.section.find('['); open != std::string::npos) {
    const std::string index = result.section.substr(open + 1);
    const auto digits = index.find_first_not_of("0123456789");
    if (digits == 0 || digits > 6 || digits + 1 != index.size() || index[digits] != ']') return {};
    result.index = std::stoul(index);
    result.section.resize(open);
  }
  if (!is_bare(result.section) || !is_bare(result.key)) return {};
  return result;
}

std::string message(const std::vector<InputIssue>& issues) {
  std::string text = fmt::format("{} problem{} in the input", issues.size(), issues.size() == 1 ? "" : "s");
  for (std::size_t i = 0; i < std::min(issues.size(), max_issues_printed); ++i) {
    const InputIssue& issue = issues[i];
    text += fmt::format("\n\n{}{}{}\n  expected: {}\n  found:    {}", issue.where,
                        issue.key.empty() ? "" : ": ", issue.key, issue.expected, issue.found);
    if (!issue.hint.empty()) text += "\n  hint:     " + issue.hint;
  }
  if (issues.size() > max_issues_printed)
    text += fmt::format("\n\nand {} more", issues.size() - max_issues_printed);
  return text;
}

using Row = std::array<std::string, 6>;

Row row_of(const KeySpec& spec) {
  static constexpr std::array nouns{"real", "integer", "boolean", "text", "choice"};
  const std::string choices = fmt::format("{}", fmt::join(spec.choices, ", "));
  return {spec.name,
          type_text(spec, nouns[static_cast<std::size_t>(spec.kind)]),
          spec.unit,
          spec.required ? "required" : spec.default_text,
          spec.kind == Kind::choice ? choices : range_text(spec),
          spec.doc};
}

}  // namespace

/// Walks the TOML tree on behalf of a Schema.
class Binder {
 public:
  explicit Binder(Schema& schema) : schema_(schema) {}

  void apply_override(toml::table& root, const std::string& text) {
    const auto given = split_override(text);
    if (!given) return reject(literal(clip(text, 80)), "", "table.key=value or list[i].key=value");
    const Section* section = schema_.find(given->section);
    const std::string key = fmt::format("{}.{}", given->section, given->key);
    if (section && section->is_list && !given->index)
      return reject("no index", key, fmt::format("{}[i].{}", given->section, given->key));
    if (section && !section->is_list && given->index) return reject("an index", key, key);
    toml::table* home = section && section->is_list ? element(root, *given) : single(root, given->section);
    if (!home) return;  // not a table in the file, which binding reports
    try {
      toml::table holder = override_value(*given);
      holder.begin()->second.visit([&](auto& node) { home->insert_or_assign(given->key, std::move(node)); });
    } catch (const Broken& broken) {
      reject(broken.found, key, broken.expected);
    }
  }

  void bind(const toml::table& root) {
    for (const Section& section : schema_.sections_) {
      const toml::node* node = root.get(section.table.name());
      section.is_list ? bind_list(section, node) : bind_single(section, node);
    }
    for (const auto& [key, node] : root)
      if (!schema_.find(std::string(key.str()))) report_unknown_section(std::string(key.str()), node);
  }

 private:
  using Section = Schema::Section;
  using Place = Schema::Place;

  static Place place(const toml::node& node) {
    const auto& source = node.source();  // none: a table made for an override
    if (!source.path || *source.path == command_line) return {command_line, after_file, describe(node)};
    return {fmt::format("{}:{}", *source.path, source.begin.line), source.begin.line, describe(node)};
  }

  void reject(const std::string& found, const std::string& key, const std::string& expected) {
    schema_.report({command_line, after_file, found}, key, expected);
  }

  void missing(const std::string& key, const std::string& expected, const std::string& hint = {}) {
    schema_.report({schema_.source_, after_lines, "nothing"}, key, expected, hint);
  }

  void wrong(const toml::node& node, const std::string& key, const std::string& expected,
             const std::string& hint = {}) {
    schema_.report(place(node), key, expected, hint);
  }

  /// A table with one key. A value that is not TOML, or not a text where one is wanted, is a bare text: the
  /// shell has eaten its quotes.
  toml::table override_value(const Override& given) const {
    const Section* section = schema_.find(given.section);
    const KeySpec* spec = section ? section->table.find(given.key) : nullptr;
    const bool wants_text = spec && !spec->list && (spec->kind == Kind::text || spec->kind == Kind::choice);
    try {
      toml::table holder = read_toml("v = " + given.value, command_line);
      if (holder.size() == 1 && (!wants_text || holder.begin()->second.is_string())) return holder;
    } catch (const Broken&) {
    }
    return read_toml("v = " + literal(given.value), command_line);
  }

  static toml::table* single(toml::table& root, const std::string& name) {
    if (!root.contains(name)) root.insert(name, toml::table{});
    return root.get_as<toml::table>(name);
  }

  toml::table* element(toml::table& root, const Override& given) {
    if (!root.contains(given.section)) root.insert(given.section, toml::array{});
    toml::array* list = root.get_as<toml::array>(given.section);
    if (!list) return nullptr;
    if (*given.index == list->size()) list->push_back(toml::table{});
    if (*given.index < list->size()) return (*list)[*given.index].as_table();
    reject(fmt::format("{}", *given.index), fmt::format("{}[{}].{}", given.section, *given.index, given.key),
           fmt::format("an index from 0 to {} (which appends)", list->size()));
    return nullptr;
  }

  void bind_single(const Section& section, const toml::node* node) {
    const std::string& name = section.table.name();
    if (node && !node->is_table()) return wrong(*node, name, fmt::format("one table [{}]", name));
    if (node) {
      schema_.given_[name] = place(*node);
      return bind_table(*node->as_table(), section.table, name);
    }
    if (section.presence == Schema::Presence::required) missing(name, fmt::format("a table [{}]", name));
    if (section.presence == Schema::Presence::implied) bind_table({}, section.table, name);
  }

  void bind_list(const Section& section, const toml::node* node) {
    const std::string& name = section.table.name();
    const toml::array* list = node ? node->as_array() : nullptr;
    if (node && !list) return wrong(*node, name, fmt::format("a list of tables [[{}]]", name));
    section.resize(list ? list->size() : 0);
    if (list && !list->empty()) schema_.given_[name] = place(*node);
    if (section.size() == 0 && section.presence == Schema::Presence::required)
      missing(name, fmt::format("at least one [[{}]]", name));
    for (std::size_t i = 0; i < section.size(); ++i) {
      const toml::node& item = *list->get(i);
      const std::string path = fmt::format("{}[{}]", name, i);
      schema_.given_[path] = place(item);
      Table element(name, section.table.doc());
      section.declare(element, i);
      item.is_table() ? bind_table(*item.as_table(), element, path) : wrong(item, path, "a table");
    }
  }

  void bind_table(const toml::table& node, const Table& table, const std::string& path) {
    for (const Key& key : table.keys()) {
      const std::string full = path + "." + key.spec().name;
      const toml::node* value = node.get(key.spec().name);
      if (value) bind_key(key.spec(), *value, full);
      if (value || !key.spec().required) continue;
      const auto home = schema_.given_.find(path);
      const bool absent = home == schema_.given_.end();
      missing(full, expected_text(key.spec()),
              absent ? "" : fmt::format("{} is at {}", path, home->second.where));
    }
    for (const auto& [key, value] : node)
      if (!table.find(std::string(key.str()))) report_unknown_key(std::string(key.str()), value, table, path);
  }

  void bind_key(const KeySpec& spec, const toml::node& node, const std::string& full) {
    schema_.given_[full] = place(node);
    const toml::array* list = node.as_array();
    if (spec.list && (!list || (spec.length > 0 && list->size() != spec.length)))
      return wrong(node, full, expected_text(spec));
    Items items;
    const std::size_t count = spec.list ? list->size() : 1;
    for (std::size_t i = 0; i < count; ++i) {
      const auto item = spec.list ? read_item(spec, *list->get(i), fmt::format("{}[{}]", full, i))
                                  : read_item(spec, node, full);
      if (item) items.push_back(*item);
    }
    if (items.size() == count) spec.set(items);
  }

  /// Nothing once its problem is reported.
  std::optional<Item> read_item(const KeySpec& spec, const toml::node& node, const std::string& key) {
    const auto item = read_scalar(spec.kind, node);
    if (item && accepts(spec, *item)) return item;
    const auto integer = node.value_exact<std::int64_t>();
    std::string hint = suggestion(node.value_exact<std::string>().value_or(""), spec.choices);
    if (item && integer && (*integer < spec.smallest || *integer > spec.largest))
      hint = "an integer here has 32 bits";
    wrong(node, key, expected_text(spec), hint);
    return {};
  }

  /// For a key that stands in the wrong table.
  std::string home_of(const std::string& key) const {
    for (const Section& section : schema_.sections_)
      if (section.table.find(key)) return fmt::format("{} is a key of [{}]", key, section.table.name());
    return "";
  }

  void report_unknown_key(const std::string& key, const toml::node& node, const Table& table,
                          const std::string& path) {
    std::vector<std::string> known;
    for (const Key& declared : table.keys()) known.push_back(declared.spec().name);
    std::string hint = home_of(key);
    if (hint.empty()) hint = suggestion(key, known);
    if (hint.empty()) hint = fmt::format("[{}] has the keys {}", table.name(), fmt::join(known, ", "));
    wrong(node, fmt::format("{}.{}", path, shown(key)), "a known key", hint);
  }

  void report_unknown_section(const std::string& key, const toml::node& node) {
    std::vector<std::string> known;
    for (const Section& section : schema_.sections_) known.push_back(section.table.name());
    const bool is_table = node.is_table() || node.is_array_of_tables();
    std::string hint = is_table ? "" : home_of(key);
    if (hint.empty()) hint = suggestion(key, known);
    if (hint.empty()) hint = fmt::format("the tables are {}", fmt::join(known, ", "));
    wrong(node, shown(key), is_table ? "a known table" : "a table (keys belong in tables)", hint);
  }

  Schema& schema_;
};

// ---- InputError, Table ----

InputError::InputError(std::vector<InputIssue> issues)
    : std::runtime_error(message(issues)),
      issues_(std::make_shared<const std::vector<InputIssue>>(std::move(issues))) {}

Table::Table(std::string name, std::string doc) : name_(std::move(name)), doc_(std::move(doc)) {
  if (!is_bare(name_)) throw std::logic_error("bad table name " + name_);
}

const KeySpec* Table::find(const std::string& name) const {
  const auto key = std::ranges::find(
      keys_, name, [](const Key& k) -> auto& { return k.spec().name; });
  return key == keys_.end() ? nullptr : &key->spec();
}

Key& Table::add(KeySpec spec) {
  if (!is_bare(spec.name)) throw std::logic_error(fmt::format("bad key name {}.{}", name_, spec.name));
  if (find(spec.name)) throw std::logic_error(fmt::format("key declared twice: {}.{}", name_, spec.name));
  const auto value = spec.get();
  spec.default_text = value ? literal(spec, *value) : "unset";
  return keys_.emplace_back(std::move(spec));
}

// ---- Schema ----

Schema::Section& Schema::add_section(std::string name, std::string doc, Presence presence, bool is_list) {
  if (find(name)) throw std::logic_error("table declared twice: " + name);
  return sections_.emplace_back(std::move(name), std::move(doc), presence, is_list);
}

Table& Schema::table(std::string name, std::string doc, Presence presence) {
  return add_section(std::move(name), std::move(doc), presence, false).table;
}

const Schema::Section* Schema::find(const std::string& name) const {
  const auto section = std::ranges::find(
      sections_, name, [](const Section& s) -> auto& { return s.table.name(); });
  return section == sections_.end() ? nullptr : &*section;
}

void Schema::verify_defaults() const {
  for (const Section& section : sections_)
    for (const Key& key : section.table.keys()) {
      const KeySpec& spec = key.spec();
      const auto value = spec.required ? std::nullopt : spec.get();
      if (value && !std::ranges::all_of(*value, [&](const Item& item) { return accepts(spec, item); }))
        throw std::logic_error(fmt::format("the default of {}.{} is {}, not {}", section.table.name(),
                                           spec.name, literal(spec, *value), expected_text(spec)));
    }
}

void Schema::parse(const std::string& path, const std::vector<std::string>& overrides) {
  std::string text;
  try {
    text = read_file(path);
  } catch (const Broken& broken) {
    throw InputError({{path, "", broken.expected, broken.found, ""}});
  }
  parse_text(text, path, overrides);
}

void Schema::parse_text(const std::string& toml, const std::string& name,
                        const std::vector<std::string>& overrides) {
  verify_defaults();
  source_ = name.empty() ? "input" : name;
  given_.clear();
  findings_.clear();
  try {
    toml::table root = read_toml(toml, source_);
    Binder binder(*this);
    for (const std::string& text : overrides) binder.apply_override(root, text);
    binder.bind(root);
    run_checks();
  } catch (const Broken& broken) {
    const std::string where = broken.line > 0 ? fmt::format("{}:{}", source_, broken.line) : source_;
    report({where, broken.line, broken.found}, "", broken.expected);
  }
  throw_findings();
}

void Schema::report(const Place& place, std::string key, std::string expected, std::string hint) {
  findings_.push_back(
      {place.order, {place.where, std::move(key), std::move(expected), place.found, std::move(hint)}});
}

bool Schema::sound(const std::vector<std::string>& uses) const {
  const auto inside = [](const std::string& inner, const std::string& outer) {
    return inner == outer || inner.starts_with(outer + ".") || inner.starts_with(outer + "[");
  };
  return std::ranges::none_of(findings_, [&](const Finding& finding) {
    const std::string& key = finding.issue.key;
    return uses.empty() || std::ranges::any_of(uses, [&](const std::string& use) {
             return inside(key, use) || inside(use, key);
           });
  });
}

void Schema::run_checks() {
  std::vector<const Check*> ready;  // chosen first: one failed check must not silence the next
  for (const Check& check : checks_)
    if (sound(check.uses)) ready.push_back(&check);
  Checks checks(*this);
  for (const Check* check : ready) check->run(checks);
}

void Schema::throw_findings() {
  if (findings_.empty()) return;
  std::ranges::stable_sort(findings_, {}, &Finding::order);
  std::vector<InputIssue> issues;
  for (Finding& finding : findings_) issues.push_back(std::move(finding.issue));
  throw InputError(std::move(issues));
}

Schema::Place Schema::place_of(const std::string& key) const {
  if (const auto own = given_.find(key); own != given_.end()) return own->second;
  const std::string home = key.substr(0, key.rfind('.'));
  const Section* section = find(home.substr(0, home.find('[')));
  const KeySpec* spec = section && home != key ? section->table.find(key.substr(home.size() + 1)) : nullptr;
  const auto parent = given_.find(home);
  Place place = parent == given_.end() ? Place{source_, after_lines, ""} : parent->second;
  place.found = spec && !spec->required ? fmt::format("nothing (default {})", spec->default_text) : "nothing";
  return place;
}

bool Checks::overridden(const std::string& key) const {
  const auto place = schema_.given_.find(key);
  return place != schema_.given_.end() && place->second.where == "command line";
}

void Checks::fail(const std::string& key, std::string expected, std::string found) {
  Schema::Place place = schema_.place_of(key);
  if (!found.empty()) place.found = std::move(found);
  schema_.report(place, key, std::move(expected));
}

// ---- listings ----

std::string Schema::heading(const Section& section) {
  const bool needed = section.presence == Presence::required;
  std::string note = needed                                  ? "required"
                     : section.presence == Presence::implied ? "may be left out"
                                                             : "optional";
  if (section.is_list) note = needed ? "list, at least one" : "list";
  const std::string& name = section.table.name();
  return fmt::format(fmt::runtime(section.is_list ? "[[{}]] ({})" : "[{}] ({})"), name, note);
}

std::string Schema::keys_text() const {
  const Row titles{"key", "type", "unit", "default", "allowed", "meaning"};
  std::array<std::size_t, 5> width{};
  const auto line = [&](const Row& row, bool print) {
    std::string text = " ";
    for (std::size_t i = 0; i < width.size(); ++i) {
      width[i] = std::max(width[i], row[i].size());
      if (print) text += fmt::format(" {:<{}} ", row[i], width[i]);
    }
    return text + " " + row.back() + "\n";
  };
  std::string text;
  for (const bool print : {false, true}) {
    text = line(titles, print);
    for (const Section& section : sections_) {
      text += fmt::format("\n{} {}\n", heading(section), section.table.doc());
      for (const Key& key : section.table.keys()) text += line(row_of(key.spec()), print);
    }
  }
  return text;
}

std::string Schema::keys_markdown() const {
  std::string text = "# Input keys\n\nGenerated from the declarations in the code.\n";
  for (const Section& section : sections_) {
    text += fmt::format("\n## {}\n\n{}\n\n", heading(section), section.table.doc());
    text += "| key | type | unit | default | allowed | meaning |\n|---|---|---|---|---|---|\n";
    for (const Key& key : section.table.keys()) {
      Row row = row_of(key.spec());
      for (std::string& cell : row)
        for (std::size_t i = 0; (i = cell.find('|', i)) != std::string::npos; i += 2) cell.insert(i, 1, '\\');
      row[0] = fmt::format("`{}`", row[0]);
      text += fmt::format("| {} |\n", fmt::join(row, " | "));
    }
  }
  return text;
}

std::string Schema::resolved_toml() const {
  std::string text;
  const auto write = [&text](const Table& table, const char* open, const char* close) {
    text += fmt::format("{}{}{}{}\n", text.empty() ? "" : "\n", open, table.name(), close);
    for (const Key& key : table.keys())
      if (const auto value = key.spec().get())
        text += fmt::format("{} = {}\n", key.spec().name, literal(key.spec(), *value));
  };
  for (const Section& section : sections_) {
    if (!section.is_list && (section.presence != Presence::optional || has_table(section.table.name())))
      write(section.table, "[", "]");
    for (std::size_t i = 0; section.is_list && i < section.size(); ++i) {
      Table element(section.table.name(),
                    section.table.doc());  // the vector may have changed since the input
      section.declare(element, i);
      write(element, "[[", "]]");
    }
  }
  return text;
}

}  // namespace dendrift::io

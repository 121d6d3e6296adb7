// From the tree of an input file to the bound variables.
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "io/config.hpp"
#include "io/config_text.hpp"
#include "io/config_toml.hpp"

namespace dendrift::io {

using namespace detail;

namespace {

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

}  // namespace dendrift::io

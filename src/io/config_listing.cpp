// What the program says about its keys and about mistakes in them: --keys, docs/keys.md, the resolved input, messages.
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <set>
#include <sstream>

#include "io/config.hpp"
#include "io/config_text.hpp"

namespace dendrift::io {

using namespace detail;

namespace {

constexpr std::size_t max_issues_printed = 100;

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

/// The lines of a resolved input by "table.key" or "list[i].key"; tables and elements of lists are there by themselves.
std::map<std::string, std::string> flattened(const std::string& resolved) {
  std::map<std::string, std::string> values;
  std::map<std::string, int> elements;
  std::string home;
  std::istringstream lines(resolved);
  for (std::string line; std::getline(lines, line);) {
    const auto equals = line.find(" = ");
    if (line.starts_with("[[")) {
      const std::string name = line.substr(2, line.size() - 4);
      home = fmt::format("{}[{}]", name, elements[name]++);
    } else if (line.starts_with("[")) {
      home = line.substr(1, line.size() - 2);
    } else if (equals != std::string::npos) {
      values[home + "." + line.substr(0, equals)] = line.substr(equals + 3);
    }
    if (line.starts_with("[")) values[home] = "";
  }
  return values;
}

std::string home_of(const std::string& key) { return key.substr(0, key.rfind('.')); }

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

InputError::InputError(std::vector<InputIssue> issues)
    : std::runtime_error(message(issues)),
      issues_(std::make_shared<const std::vector<InputIssue>>(std::move(issues))) {}

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

std::string Schema::default_of(const std::string& key) const {
  const std::string home = home_of(key);
  const Section* section = find(home.substr(0, home.find('[')));
  const KeySpec* spec = section ? section->table.find(key.substr(home.size() + 1)) : nullptr;
  return !spec ? "unknown to this version" : spec->required ? "unset" : spec->default_text;
}

std::vector<InputChange> Schema::changes_since(const std::string& resolved) const {
  const auto before = flattened(resolved), after = flattened(resolved_toml());
  std::set<std::string> keys;
  for (const auto* values : {&before, &after})
    for (const auto& [key, value] : *values) keys.insert(key);
  std::vector<InputChange> changes;
  for (const std::string& key : keys) {
    const bool table = home_of(key) == key, was = before.contains(key), is = after.contains(key);
    if (table && was != is) changes.push_back({key, was ? "present" : "absent", is ? "present" : "absent"});
    if (table || !before.contains(home_of(key)) || !after.contains(home_of(key))) continue;
    const std::string a = was ? before.at(key) : default_of(key), b = is ? after.at(key) : default_of(key);
    if (a != b) changes.push_back({key, a, b});
  }
  return changes;
}

}  // namespace dendrift::io

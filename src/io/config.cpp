#include "io/config.hpp"

#include <fmt/format.h>

#include "io/config_text.hpp"

namespace dendrift::io {

using namespace detail;

// ---- Table ----

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

InputIssue Schema::issue(const std::string& key, std::string expected, std::string found) const {
  const Place place = place_of(key);
  return {place.where, key, std::move(expected), found.empty() ? place.found : std::move(found), ""};
}

InputError Schema::error(const std::string& key, std::string expected, std::string found) const {
  return InputError({issue(key, std::move(expected), std::move(found))});
}

bool Checks::overridden(const std::string& key) const {
  const auto place = schema_.given_.find(key);
  return place != schema_.given_.end() && place->second.where == command_line;
}

void Checks::fail(const std::string& key, std::string expected, std::string found) {
  Schema::Place place = schema_.place_of(key);
  if (!found.empty()) place.found = std::move(found);
  schema_.report(place, key, std::move(expected));
}

}  // namespace dendrift::io

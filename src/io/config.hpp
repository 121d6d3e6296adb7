// Strict, declarative TOML input: every key is declared once and bound to the variable that receives it.
#pragma once

#include <algorithm>
#include <array>
#include <concepts>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <ranges>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

namespace dendrift::io {

/// One problem in the input. `hint` may be empty.
struct InputIssue {
  std::string where;  ///< "file.toml:12", "file.toml" or "command line"
  std::string key, expected, found, hint;
};

/// A key, or a table, that stands differently in two inputs.
struct InputChange {
  std::string key, before, after;
};

/// Every problem of one input; what() counts them and gives a paragraph to each.
class InputError : public std::runtime_error {
 public:
  explicit InputError(std::vector<InputIssue> issues);
  const std::vector<InputIssue>& issues() const noexcept { return *issues_; }

 private:
  std::shared_ptr<const std::vector<InputIssue>> issues_;  // shared: copying an exception must not throw
};

/// Values on their way between TOML and a variable: one for a scalar key, any number for a list.
using Item = std::variant<bool, std::int64_t, double, std::string>;
using Items = std::vector<Item>;

enum class Kind { real, integer, boolean, text, choice };

struct KeySpec {
  std::string name, unit, doc, default_text;
  Kind kind = Kind::real;
  bool list = false;
  std::size_t length = 0;  ///< fixed length of a list; 0 is any
  std::vector<std::string> choices;
  double low = -std::numeric_limits<double>::infinity(), high = std::numeric_limits<double>::infinity();
  bool low_open = false, high_open = false, infinite = false, required = false;
  std::int64_t smallest = std::numeric_limits<std::int64_t>::min();  ///< what the bound integer can hold
  std::int64_t largest = std::numeric_limits<std::int64_t>::max();
  std::function<std::optional<Items>()> get;  ///< nothing: an unset optional
  std::function<void(const Items&)> set;
};

/// Fluent description of a declared key. Limits apply to every element of a list.
class Key {
 public:
  explicit Key(KeySpec spec) : spec_(std::move(spec)) {}
  Key& unit(std::string unit) { return spec_.unit = std::move(unit), *this; }
  Key& doc(std::string doc) { return spec_.doc = std::move(doc), *this; }
  Key& at_least(double limit) { return spec_.low = limit, spec_.low_open = false, *this; }
  Key& above(double limit) { return spec_.low = limit, spec_.low_open = true, *this; }
  Key& at_most(double limit) { return spec_.high = limit, spec_.high_open = false, *this; }
  Key& below(double limit) { return spec_.high = limit, spec_.high_open = true, *this; }
  Key& range(double low, double high) { return at_least(low).at_most(high); }
  Key& required() { return spec_.required = true, *this; }
  Key& allow_infinite() { return spec_.infinite = true, *this; }  ///< accept inf and -inf; nan never passes
  const KeySpec& spec() const noexcept { return spec_; }

 private:
  KeySpec spec_;
};

namespace detail {

/// The shape of a bound variable: its scalar type, whether it is a list, and the length of a fixed list.
template <class T>
struct Shape {
  using Scalar = T;
  static constexpr bool optional = false, list = false;
  static constexpr std::size_t length = 0;
};
template <class T>
struct Shape<std::vector<T>> : Shape<T> {
  static constexpr bool list = true;
};
template <class T, std::size_t N>
struct Shape<std::array<T, N>> : Shape<T> {
  static constexpr bool list = true;
  static constexpr std::size_t length = N;
};
template <class T>
struct Shape<std::optional<T>> : Shape<T> {
  static constexpr bool optional = true;
};

template <class T>
concept Integer = std::integral<T> && !std::same_as<T, bool>;
template <class T>
using Wide = std::conditional_t<Integer<T>, std::int64_t, T>;

template <class T>
std::optional<Items> pack(const T& variable) {
  if constexpr (Shape<T>::optional) {
    return variable ? pack(*variable) : std::nullopt;
  } else if constexpr (Shape<T>::list) {
    Items items;
    for (const auto& item : variable) items.emplace_back(Wide<typename T::value_type>{item});
    return items;
  } else {
    return Items{Item(Wide<T>{variable})};
  }
}

template <class T>
void unpack(const Items& items, T& variable) {
  using Scalar = typename Shape<T>::Scalar;
  const auto scalar = [](const Item& item) { return static_cast<Scalar>(std::get<Wide<Scalar>>(item)); };
  if constexpr (Shape<T>::optional) {
    unpack(items, variable.emplace());
  } else if constexpr (Shape<T>::list) {
    if constexpr (Shape<T>::length == 0) variable.resize(items.size());
    std::ranges::transform(items, variable.begin(), scalar);
  } else {
    variable = scalar(items.front());
  }
}

template <class T>
constexpr Kind kind_of() {
  if constexpr (std::same_as<T, bool>) return Kind::boolean;
  if constexpr (Integer<T>) return Kind::integer;
  return std::same_as<T, double> ? Kind::real : Kind::text;
}

}  // namespace detail

/// One [table], or one element of a [[list]]. Bound variables must outlive it; their current values are the
/// defaults. An unset optional has no default and is left out of the resolved input.
class Table {
 public:
  Table(std::string name, std::string doc);
  Table(const Table&) = delete;
  Table& operator=(const Table&) = delete;

  Key& real(std::string name, double& target) { return bind(std::move(name), target); }
  Key& real(std::string name, std::optional<double>& target) { return bind(std::move(name), target); }
  Key& integer(std::string name, int& target) { return bind(std::move(name), target); }
  Key& integer(std::string name, std::int64_t& target) { return bind(std::move(name), target); }
  Key& integer(std::string name, std::optional<int>& target) { return bind(std::move(name), target); }
  Key& boolean(std::string name, bool& target) { return bind(std::move(name), target); }
  Key& text(std::string name, std::string& target) { return bind(std::move(name), target); }
  Key& text(std::string name, std::optional<std::string>& target) { return bind(std::move(name), target); }
  Key& reals(std::string name, std::vector<double>& target) { return bind(std::move(name), target); }
  template <std::size_t N>
  Key& reals(std::string name, std::array<double, N>& target) {
    return bind(std::move(name), target);
  }
  template <std::size_t N>
  Key& reals(std::string name, std::optional<std::array<double, N>>& target) {
    return bind(std::move(name), target);
  }
  Key& integers(std::string name, std::vector<int>& target) { return bind(std::move(name), target); }
  template <std::size_t N>
  Key& integers(std::string name, std::array<int, N>& target) {
    return bind(std::move(name), target);
  }
  template <std::size_t N>
  Key& integers(std::string name, std::optional<std::array<int, N>>& target) {
    return bind(std::move(name), target);
  }
  Key& texts(std::string name, std::vector<std::string>& target) { return bind(std::move(name), target); }

  /// A name from a fixed set, for example an enum.
  template <class E>
  Key& choice(std::string name, E& target,
              std::vector<std::pair<std::string, std::type_identity_t<E>>> cases) {
    KeySpec spec;
    spec.name = std::move(name);
    spec.kind = Kind::choice;
    for (const auto& [label, value] : cases) spec.choices.push_back(label);
    spec.get = [&target, cases]() -> std::optional<Items> {
      for (const auto& [label, value] : cases)
        if (value == target) return Items{label};
      return Items{std::string()};  // no such case: rejected as a bad default
    };
    spec.set = [&target, cases](const Items& items) {
      for (const auto& [label, value] : cases)
        if (label == std::get<std::string>(items.front())) target = value;
    };
    return add(std::move(spec));
  }

  const std::string& name() const noexcept { return name_; }
  const std::string& doc() const noexcept { return doc_; }
  const std::deque<Key>& keys() const noexcept { return keys_; }
  const KeySpec* find(const std::string& name) const;

 private:
  Key& add(KeySpec spec);

  template <class T>
  Key& bind(std::string name, T& target) {
    using Shape = detail::Shape<T>;
    using Scalar = typename Shape::Scalar;
    KeySpec spec;
    spec.name = std::move(name);
    spec.kind = detail::kind_of<Scalar>();
    spec.list = Shape::list;
    spec.length = Shape::length;
    if constexpr (detail::Integer<Scalar>) {
      spec.smallest = std::numeric_limits<Scalar>::min();
      spec.largest = std::numeric_limits<Scalar>::max();
    }
    spec.get = [&target] { return detail::pack(target); };
    spec.set = [&target](const Items& items) { detail::unpack(items, target); };
    return add(std::move(spec));
  }

  std::string name_, doc_;
  std::deque<Key> keys_;  // a deque: references handed out stay valid
};

class Checks;

/// The whole input. Declare everything, then parse once. Declaring a name twice, or a default outside its own
/// range, is a programming error (std::logic_error). After an InputError the bound variables hold a mixture
/// of defaults and accepted values.
class Schema {
 public:
  /// How a table left out of the input is treated: `optional` stays absent (a feature not asked for),
  /// `implied` acts as if it stood there empty, `required` is an error. A required list needs at least one
  /// element.
  enum class Presence { optional, implied, required };

  Schema() = default;
  Schema(const Schema&) = delete;
  Schema& operator=(const Schema&) = delete;

  Table& table(std::string name, std::string doc, Presence presence = Presence::optional);

  /// [[name]]: `declare` runs once on a default T for the listings and once per element. `target` is replaced
  /// by the elements of the input and has no default of its own.
  template <class T>
  void list(std::string name, std::string doc, std::vector<T>& target,
            std::type_identity_t<std::function<void(Table&, T&)>> declare,
            Presence presence = Presence::optional) {
    auto model = std::make_shared<T>();
    Section& section = add_section(std::move(name), std::move(doc), presence, true);
    section.resize = [&target](std::size_t size) { target = std::vector<T>(size); };
    section.size = [&target] { return target.size(); };
    section.declare = [&target, declare](Table& table, std::size_t i) { declare(table, target[i]); };
    section.model = model;
    declare(section.table, *model);
  }

  /// A cross-key check, run after binding. The first form runs only when the input has no other problem; the
  /// second whenever the tables and keys it names ("table" or "table.key") have none, so that its failures
  /// are reported together with problems elsewhere and it never sees a value outside its range.
  void check(std::function<void(Checks&)> run) { checks_.push_back({{}, std::move(run)}); }
  void check(std::vector<std::string> uses, std::function<void(Checks&)> run) {
    checks_.push_back({std::move(uses), std::move(run)});
  }

  /// Each override is "table.key=value" or "list[i].key=value"; it wins over the file and over earlier ones.
  void parse(const std::string& path, const std::vector<std::string>& overrides = {});
  void parse_text(const std::string& toml, const std::string& name,
                  const std::vector<std::string>& overrides = {});

  bool has_table(const std::string& name) const { return given_.contains(name); }
  bool given(const std::string& key) const { return given_.contains(key); }  ///< "table.key", "list[i].key"
  /// A problem with `key` that shows only after parsing, to be thrown; `found` empty: what the input says there.
  InputError error(const std::string& key, std::string expected, std::string found = {}) const;
  InputIssue issue(const std::string& key, std::string expected, std::string found = {}) const;

  std::string keys_text() const;
  std::string keys_markdown() const;
  /// Every key of every list element and of every table that is present, implied or required, as TOML that
  /// parses back to the same values bit by bit.
  std::string resolved_toml() const;
  /// What this input changes against the resolved one of another run, perhaps of another version: a key that only one of
  /// them knows has its default in the other.
  std::vector<InputChange> changes_since(const std::string& resolved) const;

 private:
  friend class Checks;
  friend class Binder;  // walks the TOML tree, which this header does not know

  struct Section {
    Section(std::string name, std::string doc, Presence how, bool is_a_list)
        : table(std::move(name), std::move(doc)), presence(how), is_list(is_a_list) {}
    Table table;  // of a list: the model element
    Presence presence;
    bool is_list;
    std::function<void(std::size_t)> resize;
    std::function<std::size_t()> size;
    std::function<void(Table&, std::size_t)> declare;
    std::shared_ptr<void> model;
  };
  struct Place {
    std::string where;
    std::size_t order;  // issues are reported by line, then whole-file ones, then the command line
    std::string found;
  };
  struct Finding {
    std::size_t order;
    InputIssue issue;
  };
  struct Check {
    std::vector<std::string> uses;
    std::function<void(Checks&)> run;
  };

  Section& add_section(std::string name, std::string doc, Presence presence, bool is_list);
  const Section* find(const std::string& name) const;
  static std::string heading(const Section& section);
  std::string default_of(const std::string& key) const;
  void verify_defaults() const;
  bool sound(const std::vector<std::string>& uses) const;
  Place place_of(const std::string& key) const;
  void report(const Place& place, std::string key, std::string expected, std::string hint = {});
  void run_checks();
  void throw_findings();

  std::deque<Section> sections_;
  std::vector<Check> checks_;
  std::map<std::string, Place> given_;
  std::vector<Finding> findings_;
  std::string source_;
};

/// What a cross-key check sees.
class Checks {
 public:
  explicit Checks(Schema& schema) : schema_(schema) {}
  /// Reports `key`; its line, and what was found there unless given, are looked up.
  void fail(const std::string& key, std::string expected, std::string found = {});
  bool given(const std::string& key) const { return schema_.given(key); }
  bool has_table(const std::string& name) const { return schema_.has_table(name); }
  /// Given on the command line, which wins over the file.
  bool overridden(const std::string& key) const;

 private:
  Schema& schema_;
};

}  // namespace dendrift::io

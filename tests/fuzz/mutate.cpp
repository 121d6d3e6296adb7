#include "mutate.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <limits>
#include <sstream>

namespace dendrift::fuzz {

namespace {

using Lines = std::vector<std::string>;

Lines lines_of(const std::string& text) {
  Lines lines;
  std::istringstream in(text);
  for (std::string line; std::getline(in, line);) lines.push_back(line);
  if (lines.empty()) lines.emplace_back();
  return lines;
}

std::string joined(const Lines& lines) {
  std::string text;
  for (const std::string& line : lines) text += line + '\n';
  return text;
}

template <class F>
void edit_lines(std::string& text, F&& f) {
  Lines lines = lines_of(text);
  f(lines);
  text = joined(lines);
}

std::ptrdiff_t place(const Lines& lines, Chance& chance) { return static_cast<std::ptrdiff_t>(chance.below(lines.size())); }

struct Span {
  std::size_t begin, size;
};

std::vector<Span> numbers_in(const std::string& text) {
  std::vector<Span> found;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto is = [&](std::size_t k, const char* more) {
      return k < text.size() && (std::isdigit(static_cast<unsigned char>(text[k])) != 0 || (text[k] != '\0' && std::strchr(more, text[k]) != nullptr));
    };
    const bool inside_word = i > 0 && (std::isalnum(static_cast<unsigned char>(text[i - 1])) != 0 || text[i - 1] == '_');
    if (!is(i, "") || inside_word) continue;
    std::size_t end = i;
    while (is(end, ".eE_") || (end > i && is(end, "+-") && (text[end - 1] == 'e' || text[end - 1] == 'E'))) ++end;
    const std::size_t begin = i > 0 && text[i - 1] == '-' ? i - 1 : i;
    found.push_back({begin, end - begin});
    i = end;
  }
  return found;
}

std::string scaled(const std::string& number, Chance& chance) {
  static const std::vector<double> factors{-1, 0.5, 2, 3, 7, 10, 0.1, 1.0001, 1e3, 1e-3, 1e6, 1e-6, 1e12, 1e-12};
  std::ostringstream out;
  const double x = std::strtod(number.c_str(), nullptr) * chance.of(factors);
  if (number.find_first_of(".eE") == std::string::npos && std::abs(x) < 1e18 && x == std::trunc(x))
    out << static_cast<long long>(x);
  else
    out << std::showpoint << x;
  return out.str();
}

void change_number(std::string& text, Chance& chance) {
  static const Lines odd{"nan", "inf", "-inf", "-1", "0", "1", "2", "3", "-0.0", "0.0", "1e308", "-1e308", "1e-308", "5e-324", "1e15", "1e6",
                         "1000000", "2147483647", "2147483648", "-2147483648", "9223372036854775807", "9223372036854775808",
                         "4294967296", std::string(400, '9'), "0." + std::string(300, '0') + "1", std::string(5000, '1') + ".0",
                         "1e999999999", "1e-999999999", "0x7fffffff", "0b11", "1_000", "1__0", "+5", ".5", "5.", "0.5", "1e3", "007"};
  const std::vector<Span> numbers = numbers_in(text);
  if (numbers.empty()) return;
  const Span at = chance.of(numbers);
  const std::string was = text.substr(at.begin, at.size);
  if (was.size() > 300) return;
  text.replace(at.begin, at.size, chance.one_in(2) ? scaled(was, chance) : chance.of(odd));
}

void change_type(std::string& text, Chance& chance) {
  static const Lines values{"\"text\"", "''", "true", "false", "[]", "[1, 2]", "[1, 2, 3]", "[1.5, \"a\"]", "[[1], [2]]", "{}", "{a = 1}",
                            "1979-05-27T07:32:00Z", "07:32:00", "1", "1.5", "\"\"\"two\nlines\"\"\"", "\"\\u0000\"", "\"\\uD800\"",
                            "[1e308, 1e308]", "[0, 0]", "[-1, -1, -1]", "[nan, inf]", "bare", "", "\"", "[", "{", "[1,,2]"};
  edit_lines(text, [&](Lines& lines) {
    std::string& line = lines[chance.below(lines.size())];
    if (const auto equals = line.find('='); equals != std::string::npos) line = line.substr(0, equals + 1) + " " + chance.of(values);
  });
}

void change_name(std::string& text, Chance& chance) {
  static const Lines names{"unknown", "dim", "a.b.c", "\"\"", "\"quoted key\"", "end_time_s", "size_um", "size_W0", "radius_W0", "file",
                           "count", "levels", "root_blocks", "\xC3\xA9", "seed", "x" + std::string(3000, 'x'), "__proto__", "-", "1"};
  static const Lines headers{"[unknown]", "[run]", "[mesh]", "[[seed]]", "[[mesh]]", "[seed]", "[flow]", "[seeds]", "[a.b.c.d]", "[]", "[[]]",
                             "[run.mesh]", "[\"run\"]", "[orientation]", "[guard]", "[output", "output]", "[[seed]"};
  edit_lines(text, [&](Lines& lines) {
    std::string& line = lines[chance.below(lines.size())];
    const auto equals = line.find('=');
    if (equals != std::string::npos) {
      line = chance.of(names) + " = " + line.substr(equals + 1);
    } else {
      line = chance.one_in(2) ? chance.of(headers) : chance.of(names) + " = 1";
    }
  });
}

void flip(std::string& text, Chance& chance) {
  for (std::size_t n = 1 + chance.below(8); n > 0 && !text.empty(); --n) {
    char& c = text[chance.below(text.size())];
    c = static_cast<char>(c ^ (1 << chance.below(8)));
  }
}

void insert_bytes(std::string& text, Chance& chance) {
  static const Lines odd{std::string(1, '\0'), "\xFF", "\xC0\x80", "\xED\xA0\x80", "\xF4\x90\x80\x80", "\xE2\x80", "\xEF\xBB\xBF", "\r", "\x1B[2J",
                         "\x7F", "\xC2\xA0", "\xE2\x80\x9C", "\"\"\"", "'''", "\\", "\"", "#", "=", "[", "]", "{", "}", ",", ".", "\n", "\t"};
  text.insert(chance.below(text.size() + 1), chance.of(odd));
}

void repeat(std::string& text, Chance& chance) {
  const std::size_t begin = chance.below(text.size() + 1), size = chance.below(std::min<std::size_t>(200, text.size() - begin) + 1);
  const std::string part = text.substr(begin, size);
  for (std::size_t n = chance.below(100); n > 0 && text.size() < 100'000; --n) text.insert(begin, part);
}

using Change = std::function<void(std::string&, const Lines&, Chance&)>;

const std::vector<Change>& changes() {
  static const auto own = [](void (*f)(std::string&, Chance&)) {
    return [f](std::string& text, const Lines&, Chance& chance) { f(text, chance); };
  };
  static const auto with_lines = [](auto f) {
    return [f](std::string& text, const Lines& others, Chance& chance) {
      edit_lines(text, [&](Lines& lines) { f(lines, others, chance); });
    };
  };
  static const std::vector<Change> all{
      own(change_number), own(change_number), own(change_number), own(change_type), own(change_name),
      with_lines([](Lines& l, const Lines&, Chance& c) { l.erase(l.begin() + place(l, c)); }),
      with_lines([](Lines& l, const Lines&, Chance& c) { std::swap(l[c.below(l.size())], l[c.below(l.size())]); }),
      with_lines([](Lines& l, const Lines& others, Chance& c) {
        const Lines lender = lines_of(c.of(others));
        l.insert(l.begin() + place(l, c), c.of(lender));
      }),
      with_lines([](Lines& l, const Lines&, Chance& c) {
        const std::size_t i = c.below(l.size());
        l.insert(l.begin() + static_cast<std::ptrdiff_t>(i), std::string(l[i]));
      }),
      // From here on, what is left is seldom TOML.
      own(flip), own(insert_bytes), own(repeat),
      own([](std::string& t, Chance& c) { t.resize(c.below(t.size() + 1)); }),
      own([](std::string& t, Chance& c) { t.erase(c.below(t.size() + 1), c.below(40)); })};
  return all;
}

}  // namespace

std::string mutate_input(std::string text, const std::vector<std::string>& others, Chance& chance) {
  constexpr std::size_t MILD = 9;  // many mutants should come as far as the checks behind the parser
  const std::size_t choice = chance.one_in(3) ? changes().size() : MILD;
  for (std::size_t n = 1 + chance.below(4); n > 0; --n) changes()[chance.below(choice)](text, others, chance);
  return text;
}

std::string mutate_bytes(std::string bytes, std::size_t begin, Chance& chance) {
  static const std::vector<std::uint64_t> odd{0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, ~std::uint64_t{0}};
  for (std::size_t n = 1 + chance.below(4); n > 0 && bytes.size() > begin + 8; --n) {
    const std::size_t at = begin + chance.below(bytes.size() - begin - 8);
    const std::uint64_t word = chance.of(odd);
    switch (chance.below(16)) {
      case 0: bytes.resize(at); break;
      case 1: bytes.replace(at, 8, bytes.substr(begin + chance.below(bytes.size() - begin - 8), 8)); break;
      case 2: std::fill_n(bytes.begin() + static_cast<std::ptrdiff_t>(at), chance.below(bytes.size() - at), '\0'); break;
      case 3: case 4: case 5: case 6: case 7:
        std::memcpy(bytes.data() + at, &word, std::size_t{1} << chance.below(4));
        break;
      default: bytes[at] = static_cast<char>(bytes[at] ^ (1 << chance.below(8)));
    }
  }
  return bytes;
}

const std::vector<double>& odd_numbers() {
  using Limits = std::numeric_limits<double>;
  static const std::vector<double> all{0, -0.0, 1, -1, 2, 0.5, 3, 1e3, 1e9, -1e9, 1e19, -1e19, 1e308, -1e308, 5e-324,
                                       Limits::infinity(), -Limits::infinity(), Limits::quiet_NaN(), 2147483647, 2147483648, 4294967296};
  return all;
}

}  // namespace dendrift::fuzz

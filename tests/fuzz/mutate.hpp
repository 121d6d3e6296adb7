/// \file
/// Spoils inputs and checkpoints, the same way whenever the seed and the number of the mutant are the same.
#pragma once

#include <cstdint>
#include <random>
#include <string>
#include <vector>

namespace dendrift::fuzz {

/// The same numbers with every standard library.
class Chance {
 public:
  Chance(std::uint64_t seed, std::uint64_t number) : engine_(seed * 0x9e3779b97f4a7c15ULL ^ (number + 1) * 0xbf58476d1ce4e5b9ULL) {}
  std::size_t below(std::size_t n) { return n == 0 ? 0 : static_cast<std::size_t>(engine_() % n); }
  bool one_in(std::size_t n) { return below(n) == 0; }
  template <class T>
  const T& of(const std::vector<T>& list) {
    return list[below(list.size())];
  }

 private:
  std::mt19937_64 engine_;
};

/// One to four changes to a text; `others` lend lines.
std::string mutate_input(std::string text, const std::vector<std::string>& others, Chance& chance);

/// One to four changes to bytes from `begin` on: flipped, overwritten with numbers that are often forgotten, cut off.
std::string mutate_bytes(std::string bytes, std::size_t begin, Chance& chance);

/// Doubles that are often forgotten.
const std::vector<double>& odd_numbers();

}  // namespace dendrift::fuzz

/// \file
/// Reading back what was remembered in a checkpoint: lists of doubles that may hold anything.
#pragma once

#include <cmath>
#include <limits>
#include <span>
#include <stdexcept>

namespace dendrift::physics {

/// A count. Throws std::out_of_range if the list is too short or no int holds the number.
inline int remembered_count(std::span<const double> memory, std::size_t i) {
  if (i >= memory.size()) throw std::out_of_range("a list that is too short");
  if (!(std::abs(memory[i]) < std::numeric_limits<int>::max())) throw std::out_of_range("a count that is none");
  return static_cast<int>(memory[i]);
}

}  // namespace dendrift::physics

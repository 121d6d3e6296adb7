/// \file
/// Random numbers from counters: the same on any number of ranks, whoever asks and in whatever order.
#pragma once

#include <cstdint>

namespace dendrift::physics {

/// splitmix64: a counter in, 64 well-mixed bits out.
inline std::uint64_t mix(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15U;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9U;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebU;
  return x ^ (x >> 31);
}

/// Uniform in [0, 1).
inline double unit(std::uint64_t bits) { return static_cast<double>(bits >> 11) * 0x1p-53; }

}  // namespace dendrift::physics

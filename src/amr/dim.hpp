/// \file
/// The number of space dimensions is a compile-time constant; one source serves both programs.
#pragma once

#include <array>
#include <cstdint>

namespace dendrift {

inline constexpr int DIM = DENDRIFT_DIM;
static_assert(DIM == 2 || DIM == 3);

template <class T>
using Array = std::array<T, DIM>;
using IntVec = Array<int>;
using RealVec = Array<double>;

inline constexpr int CHILDREN = 1 << DIM;       ///< children of a tree node
inline constexpr int FACES = 2 * DIM;           ///< faces of a block, ordered xlo, xhi, ylo, yhi, zlo, zhi
inline constexpr int DIRECTIONS = DIM == 2 ? 9 : 27;  ///< neighbour directions, the block itself included
inline constexpr int CENTRE = DIRECTIONS / 2;   ///< the direction that points nowhere

constexpr IntVec filled(int v) {
  IntVec r{};
  for (int& x : r) x = v;
  return r;
}

/// Offset in {-1,0,1}^DIM of direction number `dir` (x varies fastest).
constexpr IntVec direction_offset(int dir) {
  IntVec o{};
  for (int a = 0; a < DIM; ++a, dir /= 3) o[a] = dir % 3 - 1;
  return o;
}

/// Direction number of an offset in {-1,0,1}^DIM.
constexpr int direction_index(const IntVec& o) {
  int dir = 0;
  for (int a = DIM - 1; a >= 0; --a) dir = 3 * dir + o[a] + 1;
  return dir;
}

constexpr int face_axis(int face) { return face / 2; }
constexpr bool face_is_high(int face) { return (face & 1) != 0; }

/// Offset of the neighbour across `face`.
constexpr IntVec face_offset(int face) {
  IntVec o{};
  o[face_axis(face)] = face_is_high(face) ? 1 : -1;
  return o;
}

constexpr std::int64_t volume(const IntVec& size) {
  std::int64_t v = 1;
  for (int s : size) v *= s;
  return v;
}

}  // namespace dendrift

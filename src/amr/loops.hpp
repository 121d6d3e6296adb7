/// \file
/// Loops over boxes of cells and over blocks.
#pragma once

#include <utility>

#include "amr/dim.hpp"

namespace dendrift::amr {

/// Calls f(row) for every row of a box in index order; row[0] = 0 always, the caller runs along x.
template <class F>
inline void for_each_row(const IntVec& size, F&& f) {
  IntVec r{};
  if constexpr (DIM == 2) {
    for (r[1] = 0; r[1] < size[1]; ++r[1]) f(r);
  } else {
    for (r[2] = 0; r[2] < size[2]; ++r[2])
      for (r[1] = 0; r[1] < size[1]; ++r[1]) f(r);
  }
}

/// Calls f(cell) for every cell of a box that starts at `lo`, x fastest.
template <class F>
inline void for_each_cell(const IntVec& lo, const IntVec& size, F&& f) {
  for_each_row(size, [&](const IntVec& row) {
    IntVec c = row;
    for (int a = 0; a < DIM; ++a) c[a] += lo[a];
    for (int i = 0; i < size[0]; ++i, ++c[0]) f(std::as_const(c));
  });
}

/// Calls f(b) for 0 <= b < count on all threads of this rank. f must touch nothing that another b writes.
template <class F>
inline void parallel_for(int count, F&& f) {
#pragma omp parallel for schedule(dynamic, 1) if (count > 1)
  for (int b = 0; b < count; ++b) f(b);
}

}  // namespace dendrift::amr

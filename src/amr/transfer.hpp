/// \file
/// Moving cell means between arrays of one or two levels. All boxes are given in cells of the destination.
#pragma once

#include <cmath>
#include <cstddef>
#include <type_traits>

#include "amr/loops.hpp"
#include "amr/mesh.hpp"

namespace dendrift::amr {

/// An array whose cell (0,0[,0]) is at p; x is contiguous.
template <class T>
struct ArrayRef {
  T* p;
  Array<std::ptrdiff_t> stride;

  T* at(const IntVec& cell) const {
    std::ptrdiff_t o = 0;
    for (int a = 0; a < DIM; ++a) o += cell[a] * stride[a];
    return p + o;
  }
};

template <class T>
ArrayRef<T> array_ref(T* p, const Layout& layout) {
  ArrayRef<T> r{p, {}};
  for (int a = 0; a < DIM; ++a) r.stride[a] = layout.stride(a);
  return r;
}

/// Densely packed array of the given size.
template <class T>
ArrayRef<T> packed_ref(T* p, const IntVec& size) {
  ArrayRef<T> r{p, {}};
  std::ptrdiff_t s = 1;
  for (int a = 0; a < DIM; ++a) {
    r.stride[a] = s;
    s *= size[a];
  }
  return r;
}

/// Calls f(width) with a width that the compiler knows where it is that of ghosts: loops over a few cells are all overhead
/// otherwise.
template <class F>
inline void with_width(int width, F&& f) {
  if (width == Layout::GHOSTS) {
    f(std::integral_constant<int, Layout::GHOSTS>{});
  } else {
    f(width);
  }
}

/// Calls f(width, d, s) with the beginnings of the rows of a box and of those in `src` that belong to them: cells of a box of the
/// same size (ratio 1), or the first children (ratio 2).
template <int RATIO, class F>
inline void for_each_pair_of_rows(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src, const IntVec& src_lo,
                                  const IntVec& size, F&& f) {
  double* d0 = dst.at(dst_lo);
  const double* s0 = src.at(src_lo);
  with_width(size[0], [&](auto width) {
    for_each_row(size, [&](const IntVec& row) {
      double* d = d0;
      const double* s = s0;
      for (int a = 1; a < DIM; ++a) {
        d += row[a] * dst.stride[a];
        s += RATIO * row[a] * src.stride[a];
      }
      f(width, d, s);
    });
  });
}

inline void copy_box(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src, const IntVec& src_lo,
                     const IntVec& size) {
  for_each_pair_of_rows<1>(dst, dst_lo, src, src_lo, size, [](auto width, double* d, const double* s) {
    for (int i = 0; i < width; ++i) d[i] = s[i];
  });
}

/// dst cell = mean of its CHILDREN fine cells. `src_lo` is the fine cell that is the first child of dst_lo.
inline void restrict_box(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src,
                         const IntVec& src_lo, const IntVec& size) {
  const std::ptrdiff_t y = src.stride[1];
  for_each_pair_of_rows<2>(dst, dst_lo, src, src_lo, size, [&](auto width, double* d, const double* s) {
    for (int i = 0; i < width; ++i, s += 2) {
      double sum = (s[0] + s[1]) + (s[y] + s[y + 1]);
      if constexpr (DIM == 3) {
        const double* t = s + src.stride[2];
        sum += (t[0] + t[1]) + (t[y] + t[y + 1]);
      }
      d[i] = sum / CHILDREN;
    }
  });
}

/// Value of one child from a 3^DIM neighbourhood of means: exact for quadratics, and the children's mean is the
/// parent's value. c points at the parent, s[a] = -1 or +1 is the child's side along axis a.
inline double child_value(const double* c, const Array<std::ptrdiff_t>& stride, const Array<double>& s) {
  double v = *c;
  for (int a = 0; a < DIM; ++a) v += 0.125 * s[a] * (c[stride[a]] - c[-stride[a]]);
  for (int a = 0; a < DIM; ++a) {
    for (int b = a + 1; b < DIM; ++b) {
      const std::ptrdiff_t p = stride[a] + stride[b], m = stride[a] - stride[b];
      v += 0.015625 * s[a] * s[b] * ((c[p] + c[-p]) - (c[m] + c[-m]));
    }
  }
  return v;
}

/// Fills the fine cells of a box from coarse means. `src` counts coarse cells from the one that holds fine cell 0.
inline void prolong_box(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src, const IntVec& size) {
  for_each_cell(dst_lo, size, [&](const IntVec& fine) {
    IntVec coarse = fine;
    Array<double> side{};
    for (int a = 0; a < DIM; ++a) {
      coarse[a] = fine[a] >> 1;
      side[a] = (fine[a] & 1) != 0 ? 1.0 : -1.0;
    }
    *dst.at(fine) = child_value(src.at(coarse), src.stride, side);
  });
}

/// The smallest of all differences that are equal to x modulo `period`.
inline double wrapped(double x, double period) { return x - period * std::nearbyint(x / period); }

/// restrict_box and prolong_box for angles modulo `period`: 85 and 5 degrees are 10 degrees apart.
inline void restrict_angles(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src,
                            const IntVec& src_lo, const IntVec& size, double period) {
  for_each_cell({}, size, [&](const IntVec& cell) {
    IntVec to = dst_lo, from = src_lo;
    for (int a = 0; a < DIM; ++a) {
      to[a] += cell[a];
      from[a] += 2 * cell[a];
    }
    const double* first = src.at(from);
    double sum = 0;
    for (int child = 1; child < CHILDREN; ++child) {
      std::ptrdiff_t o = 0;
      for (int a = 0; a < DIM; ++a) o += (child >> a & 1) * src.stride[a];
      sum += wrapped(first[o] - *first, period);
    }
    *dst.at(to) = *first + sum / CHILDREN;
  });
}

inline void prolong_angles(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src, const IntVec& size,
                           double period) {
  for_each_cell(dst_lo, size, [&](const IntVec& fine) {
    IntVec coarse = fine;
    for (int a = 0; a < DIM; ++a) coarse[a] = fine[a] >> 1;
    const double* c = src.at(coarse);
    double value = *c;
    for (int a = 0; a < DIM; ++a) {
      const double below = wrapped(*c - c[-src.stride[a]], period), above = wrapped(c[src.stride[a]] - *c, period);
      const double least = std::abs(below) < std::abs(above) ? below : above;
      if (below * above > 0) value += ((fine[a] & 1) != 0 ? 0.25 : -0.25) * least;
    }
    *dst.at(fine) = value;
  });
}

/// The same for labels.
inline void restrict_labels(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src,
                            const IntVec& src_lo, const IntVec& size) {
  for_each_cell({}, size, [&](const IntVec& cell) {
    IntVec to = dst_lo, from = src_lo;
    for (int a = 0; a < DIM; ++a) {
      to[a] += cell[a];
      from[a] += 2 * cell[a];
    }
    *dst.at(to) = *src.at(from);
  });
}

inline void prolong_labels(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src, const IntVec& size) {
  for_each_cell(dst_lo, size, [&](const IntVec& fine) {
    IntVec coarse = fine;
    for (int a = 0; a < DIM; ++a) coarse[a] = fine[a] >> 1;
    *dst.at(fine) = *src.at(coarse);
  });
}

/// As the row of a field in cells asks for.
inline void restrict_cells(const FieldSpec& field, ArrayRef<double> dst, const IntVec& dst_lo,
                           ArrayRef<const double> src, const IntVec& src_lo, const IntVec& size) {
  switch (field.mixing) {
    case Mixing::means: return restrict_box(dst, dst_lo, src, src_lo, size);
    case Mixing::angles: return restrict_angles(dst, dst_lo, src, src_lo, size, field.period);
    case Mixing::labels: return restrict_labels(dst, dst_lo, src, src_lo, size);
  }
}

inline void prolong_cells(const FieldSpec& field, ArrayRef<double> dst, const IntVec& dst_lo,
                          ArrayRef<const double> src, const IntVec& size) {
  switch (field.mixing) {
    case Mixing::means: return prolong_box(dst, dst_lo, src, size);
    case Mixing::angles: return prolong_angles(dst, dst_lo, src, size, field.period);
    case Mixing::labels: return prolong_labels(dst, dst_lo, src, size);
  }
}

}  // namespace dendrift::amr

/// \file
/// Moving face-centred vectors between two levels. Index i along its own axis is the low face of cell i.
#pragma once

#include "amr/transfer.hpp"

namespace dendrift::amr {

/// child_value along all axes but `normal`; reads nothing off that plane.
inline double child_value_across(const double* c, const Array<std::ptrdiff_t>& stride, const Array<double>& s, int normal) {
  double v = *c;
  for (int a = 0; a < DIM; ++a) {
    if (a == normal) continue;
    v += 0.125 * s[a] * (c[stride[a]] - c[-stride[a]]);
    for (int b = a + 1; b < DIM; ++b) {
      if (b == normal) continue;
      const std::ptrdiff_t p = stride[a] + stride[b], m = stride[a] - stride[b];
      v += 0.015625 * s[a] * s[b] * ((c[p] + c[-p]) - (c[m] + c[-m]));
    }
  }
  return v;
}

/// Third-order value at a fine place from the coarse array round it: cells (normal < 0) or the faces of one axis.
/// `c` counts coarse cells from the one that holds fine cell 0; n: fine cells along a side. Means over the fine
/// faces of a coarse face keep its value. Needs coarse places -2 to n/2 + 1.
inline double fine_value(const ArrayRef<const double>& c, const IntVec& fine, int normal, int n) {
  IntVec coarse{};
  Array<double> s{};
  for (int a = 0; a < DIM; ++a) {
    coarse[a] = fine[a] >> 1;
    s[a] = (fine[a] & 1) != 0 ? 1.0 : -1.0;
  }
  const double* p = c.at(coarse);
  if (normal < 0) return child_value(p, c.stride, s);
  if ((fine[normal] & 1) == 0) return child_value_across(p, c.stride, s, normal);
  const std::ptrdiff_t t = c.stride[normal];
  const auto plane = [&](std::ptrdiff_t k) { return child_value_across(p + k * t, c.stride, s, normal); };
  // Between two planes of coarse faces: parabolas at the ends, where only three planes are known.
  if (fine[normal] < 0) return 0.375 * plane(0) + 0.75 * plane(1) - 0.125 * plane(2);
  if (fine[normal] > n) return 0.375 * plane(1) + 0.75 * plane(0) - 0.125 * plane(-1);
  return 0.5625 * (plane(0) + plane(1)) - 0.0625 * (plane(-1) + plane(2));
}

/// Mean over the fine cells, or over the fine faces of a coarse face, that start at p.
inline double mean_across(const double* p, const Array<std::ptrdiff_t>& stride, int normal) {
  double sum = 0;
  int count = 0;
  for (int corner = 0; corner < CHILDREN; ++corner) {
    if (normal >= 0 && (corner >> normal & 1) != 0) continue;
    std::ptrdiff_t o = 0;
    for (int a = 0; a < DIM; ++a)
      if ((corner >> a & 1) != 0) o += stride[a];
    sum += p[o];
    ++count;
  }
  return sum / count;
}

/// All faces of a block of n cells from those of its parent. The flux through a coarse face is kept, and every fine
/// cell gets the divergence of the coarse one: no divergence in, none out. `coarse` as in fine_value.
inline void prolong_faces(const Array<ArrayRef<double>>& fine, const Array<ArrayRef<const double>>& coarse, int n) {
  for (int a = 0; a < DIM; ++a) {
    IntVec size = filled(n);
    ++size[a];
    for_each_cell({}, size, [&](const IntVec& q) { *fine[a].at(q) = fine_value(coarse[a], q, a, n); });
  }
  // The faces inside a coarse cell receive the smallest change that levels the divergence of its fine cells. On the
  // graph of these cells, a hypercube, the Walsh functions w are the eigenvectors of the Laplacian, 2 |w| its eigenvalues.
  for_each_cell({}, filled(n / 2), [&](const IntVec& cell) {
    std::array<double, CHILDREN> outflow{}, potential{};
    const auto place = [&](int child) {
      IntVec q{};
      for (int a = 0; a < DIM; ++a) q[a] = 2 * cell[a] + (child >> a & 1);
      return q;
    };
    for (int child = 0; child < CHILDREN; ++child) {
      const IntVec q = place(child);
      for (int a = 0; a < DIM; ++a) {
        const double* v = fine[a].at(q);
        outflow[static_cast<std::size_t>(child)] += v[fine[a].stride[a]] - v[0];
      }
    }
    const auto sign = [](int w, int child) { return (__builtin_popcount(static_cast<unsigned>(w & child)) & 1) != 0 ? -1.0 : 1.0; };
    for (int w = 1; w < CHILDREN; ++w) {
      double sum = 0;
      for (int child = 0; child < CHILDREN; ++child) sum += sign(w, child) * outflow[static_cast<std::size_t>(child)];
      sum /= CHILDREN * 2.0 * __builtin_popcount(static_cast<unsigned>(w));
      for (int child = 0; child < CHILDREN; ++child) potential[static_cast<std::size_t>(child)] += sum * sign(w, child);
    }
    for (int child = 0; child < CHILDREN; ++child)
      for (int a = 0; a < DIM; ++a)
        if ((child >> a & 1) != 0)
          *fine[a].at(place(child)) += potential[static_cast<std::size_t>(child)] - potential[static_cast<std::size_t>(child ^ 1 << a)];
  });
}

/// dst = means of the fine faces; `size` counts cells of the coarse box, planes 0 to size along `normal`.
inline void restrict_faces(ArrayRef<double> dst, const IntVec& dst_lo, ArrayRef<const double> src, IntVec size, int normal) {
  ++size[normal];
  for_each_cell({}, size, [&](const IntVec& q) {
    IntVec fine{}, coarse{};
    for (int a = 0; a < DIM; ++a) {
      fine[a] = 2 * q[a];
      coarse[a] = dst_lo[a] + q[a];
    }
    *dst.at(coarse) = mean_across(src.at(fine), src.stride, normal);
  });
}

}  // namespace dendrift::amr

#include "amr/multigrid.hpp"

#include <algorithm>
#include <cmath>

namespace dendrift::amr {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

// kappa along each axis as a strided array: below[q] is the link under place q, below[q + s] the one over it.
struct Operator {
  Array<const double*> kappa{};
  Array<std::ptrdiff_t> stride{};
  Array<double> factor{};  // of kappa, over dx^2
  double sigma = 0;

  [[gnu::always_inline]] double below(int a, std::ptrdiff_t q) const { return kappa[a] == nullptr ? factor[a] : factor[a] * kappa[a][q]; }
};

// A x at place q. Constant: all kappa are the factors alone.
template <bool Constant>
[[gnu::always_inline]] inline double apply(const Operator& o, const double* x, std::ptrdiff_t q) {
  double sum = o.sigma * x[q];
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = o.stride[a];
    if constexpr (Constant) {
      sum += o.factor[a] * (2 * x[q] - x[q - s] - x[q + s]);
    } else {
      sum += o.factor[a] * (o.kappa[a][q] * (x[q] - x[q - s]) + o.kappa[a][q + s] * (x[q] - x[q + s]));
    }
  }
  return sum;
}

}  // namespace

Multigrid::Multigrid(Hierarchy& hierarchy, std::vector<Component> components, std::vector<Links> links,
                     const HierarchyField& coefficients, MultigridOptions options)
    : h_(hierarchy), coefficients_(coefficients), options_(options),
      x_(hierarchy, components), rhs_(hierarchy, components), step_(hierarchy, components),
      residual_(hierarchy, components), inverse_(hierarchy, components) {
  prepare(std::move(links));
}

template <class F>
void Multigrid::with_operator(int g, int i, int c, F&& f) const {
  const Links& l = links_[at(c)];
  const Grid& grid = h_.grid(g);
  Operator o;
  o.sigma = l.sigma;
  bool constant = true;
  for (int a = 0; a < DIM; ++a) {
    o.stride[a] = grid.layout.stride(a);
    o.factor[a] = l.along[a].factor / (grid.dx * grid.dx);
    if (l.along[a].field < 0) continue;
    constant = false;
    o.kappa[a] = coefficients_.at(g, i, l.along[a].field) - l.along[a].below * o.stride[a];
  }
  if (constant) {
    f(o, std::true_type{});
  } else {
    f(o, std::false_type{});
  }
}

template <class F>
void Multigrid::rows(int g, int, int, const Range& box, F&& f) const {
  const Layout& layout = h_.grid(g).layout;
  for_each_row(box.size, [&](const IntVec& row) {
    IntVec q = row;
    for (int a = 0; a < DIM; ++a) q[a] += box.lo[a];
    f(layout.offset(q), box.size[0]);
  });
}

void Multigrid::prepare(std::vector<Links> links) {
  links_ = std::move(links);
  for (int g = 0; g < h_.grids(); ++g)
    parallel_for(h_.grid(g).size(), [&](int i) {
      for (int c = 0; c < x_.components(); ++c)
        with_operator(g, i, c, [&](const Operator& o, auto) {
          double* inverse = inverse_.at(g, i, c);
          rows(g, i, c, h_.unknowns(g, i, x_.component(c), false), [&](std::ptrdiff_t q0, int count) {
            for (std::ptrdiff_t q = q0; q < q0 + count; ++q) {
              double d = o.sigma;
              for (int a = 0; a < DIM; ++a) d += o.below(a, q) + o.below(a, q + o.stride[a]);
              inverse[q] = 1 / d;
            }
          });
        });
    });
}

// Chebyshev iteration with the diagonal as preconditioner: a few multiply-adds a cell and step, no colours.
void Multigrid::smooth(int g, int steps, double lowest, bool from_zero) {
  const double hi = 2.0, lo = hi / lowest, theta = 0.5 * (hi + lo), delta = 0.5 * (hi - lo), sigma = theta / delta;
  double rho = 1 / sigma;
  for (int k = 0; k < steps; ++k) {
    const double next_rho = k == 0 ? rho : 1 / (2 * sigma - rho);
    const double momentum = k == 0 ? 0.0 : next_rho * rho, weight = k == 0 ? 1 / theta : 2 * next_rho / delta;
    rho = next_rho;
    const bool zero = from_zero && k == 0;
    if (!zero) h_.exchange(x_, g, 1);
    parallel_for(h_.grid(g).size(), [&](int i) {
      for (int c = 0; c < x_.components(); ++c) {
        const Range box = h_.unknowns(g, i, x_.component(c), false);
        double *x = x_.at(g, i, c), *d = step_.at(g, i, c);
        const double *r = rhs_.at(g, i, c), *inverse = inverse_.at(g, i, c);
        if (zero) {
          rows(g, i, c, box, [&](std::ptrdiff_t q0, int count) {
#pragma omp simd
            for (std::ptrdiff_t q = q0; q < q0 + count; ++q) x[q] = d[q] = weight * inverse[q] * r[q];
          });
          continue;
        }
        with_operator(g, i, c, [&](const Operator& o, auto constant) {
          rows(g, i, c, box, [&](std::ptrdiff_t q0, int count) {
            if (momentum == 0) {
#pragma omp simd
              for (std::ptrdiff_t q = q0; q < q0 + count; ++q)
                d[q] = weight * inverse[q] * (r[q] - apply<decltype(constant)::value>(o, x, q));
            } else {
#pragma omp simd
              for (std::ptrdiff_t q = q0; q < q0 + count; ++q)
                d[q] = weight * inverse[q] * (r[q] - apply<decltype(constant)::value>(o, x, q)) + momentum * d[q];
            }
          });
        });
        rows(g, i, c, box, [&](std::ptrdiff_t q0, int count) {
#pragma omp simd
          for (std::ptrdiff_t q = q0; q < q0 + count; ++q) x[q] += d[q];
        });
      }
    });
  }
}

// Also on the plane of faces below a node, which full weighting wants.
void Multigrid::residual(int g) {
  h_.exchange(x_, g, Layout::GHOSTS);
  parallel_for(h_.grid(g).size(), [&](int i) {
    const Grid::Node& n = h_.grid(g).mine(i);
    for (int c = 0; c < x_.components(); ++c) {
      const Component& component = x_.component(c);
      Range box = h_.unknowns(g, i, component, false);
      const double* x = x_.at(g, i, c);
      const double* b = rhs_.at(g, i, c);
      double* r = residual_.at(g, i, c);
      if (const int a = component.normal; a >= 0) {
        IntVec o{};
        o[a] = -1;
        if (n.neighbours[at(direction_index(o))] >= 0) {
          --box.lo[a];
          ++box.size[a];
        }
      }
      with_operator(g, i, c, [&](const Operator& o, auto constant) {
        rows(g, i, c, box, [&](std::ptrdiff_t q0, int count) {
#pragma omp simd
          for (std::ptrdiff_t q = q0; q < q0 + count; ++q) r[q] = b[q] - apply<decltype(constant)::value>(o, x, q);
        });
      });
    }
  });
}

// What grid g has found changes what leaves of grid g+1 at its border still have to do.
void Multigrid::couple(int g) {
  const Grid& coarse = h_.grid(g + 1);
  step_.clear(g + 1);
  h_.restrict_means(x_, step_, g);
  h_.exchange(step_, g + 1, 1);
  parallel_for(coarse.size(), [&](int i) {
    const Grid::Node& n = coarse.mine(i);
    if (n.leaf < 0) return;
    bool border = false;
    for (int f = 0; f < FACES; ++f) {
      const int m = n.neighbours[at(direction_index(face_offset(f)))];
      border = border || (m >= 0 && coarse.nodes[at(m)].leaf < 0);
    }
    if (!border) return;
    for (int c = 0; c < x_.components(); ++c)
      with_operator(g + 1, i, c, [&](const Operator& o, auto constant) {
        const double* x = step_.at(g + 1, i, c);
        double* r = rhs_.at(g + 1, i, c);
        rows(g + 1, i, c, h_.unknowns(g + 1, i, x_.component(c), true), [&](std::ptrdiff_t q0, int count) {
#pragma omp simd
          for (std::ptrdiff_t q = q0; q < q0 + count; ++q) r[q] -= apply<decltype(constant)::value>(o, x, q);
        });
      });
  });
}

void Multigrid::cycle() {
  const int last = h_.grids() - 1;
  for (int g = 0; g < last; ++g) {
    x_.clear(g);
    smooth(g, options_.smoothings, options_.lowest, true);
    // The plane below a node is another node's, whose right-hand side has to be there too.
    h_.exchange(rhs_, g, 1);
    residual(g);
    h_.restrict_weighted(residual_, rhs_, g);
    if (g + 1 < h_.levels()) couple(g);
  }
  x_.clear(last);
  smooth(last, options_.bottom_steps, 0.5 * options_.bottom_steps * options_.bottom_steps, true);
  for (int g = last - 1; g >= 0; --g) {
    h_.exchange(x_, g + 1, Layout::GHOSTS);
    h_.prolong_add(x_, g);
    smooth(g, options_.smoothings, options_.lowest, false);
  }
}

}  // namespace dendrift::amr

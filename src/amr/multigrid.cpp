#include "amr/multigrid.hpp"

#include <algorithm>
#include <cmath>

namespace dendrift::amr {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

// What a sweep is compiled for: kappa constant, variable, or variable and coupled, for the component along each axis.
enum Kind : int { COUPLED, CONSTANT = DIM, VARIABLE };

// kappa along each axis as a strided array: kappa[q] is the link under place q, kappa[q + s] the one over it.
struct Operator {
  Array<const double*> kappa{};
  Array<const double*> other{};  // coupled: the component along each axis, null for our own
  Array<std::ptrdiff_t> stride{};
  Array<double> factor{};  // of kappa, over dx^2
  const double* drag = nullptr;
  double sigma = 0;

  [[gnu::always_inline]] double below(int a, std::ptrdiff_t q) const { return kappa[a] == nullptr ? factor[a] : factor[a] * kappa[a][q]; }
};

// A x at place q.
template <int K>
[[gnu::always_inline]] inline double apply(const Operator& o, const double* x, std::ptrdiff_t q) {
  double sum = (o.sigma + o.drag[q]) * x[q];
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = o.stride[a];
    if (K == CONSTANT) {
      sum += o.factor[a] * (2 * x[q] - x[q - s] - x[q + s]);
    } else if (K < CONSTANT && a != K) {
      const double* u = o.other[a];
      const std::ptrdiff_t t = o.stride[K % DIM];
      sum += o.factor[a] * (o.kappa[a][q] * ((x[q] - x[q - s]) + (u[q] - u[q - t])) -
                            o.kappa[a][q + s] * ((x[q + s] - x[q]) + (u[q + s] - u[q + s - t])));
    } else {
      sum += o.factor[a] * (o.kappa[a][q] * (x[q] - x[q - s]) + o.kappa[a][q + s] * (x[q] - x[q + s]));
    }
  }
  return sum;
}

// The sweeps below take whole slabs of memory, ghosts between the rows included: long loops without epilogues. What
// they leave in those ghosts is never read, or zero times something.

// d = weight D^-1 (r - A x) + momentum d
template <int K>
void chebyshev_step(Operator o, const double* x, const double* r, const double* inverse, double* __restrict d,
                    std::ptrdiff_t begin, std::ptrdiff_t end, double weight, double momentum) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q) d[q] = weight * inverse[q] * (r[q] - apply<K>(o, x, q)) + momentum * d[q];
}

template <int K>
void residual_sweep(Operator o, const double* x, const double* b, double* __restrict r, std::ptrdiff_t begin, std::ptrdiff_t end) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q) r[q] = b[q] - apply<K>(o, x, q);
}

// y = x + weight D^-1 (b - A x) + momentum (x - before), before: y - x of the step before this one, or x itself if that
// began from zero; all of it as sweeps write it.
template <int K>
void second_step_from_zero(Operator o, const double* x, const double* b, const double* inverse, double* __restrict y,
                           std::ptrdiff_t begin, std::ptrdiff_t end, double weight, double momentum) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q)
    y[q] = (1 + momentum) * x[q] + weight * inverse[q] * (b[q] - apply<K>(o, x, q));
}

// The step after one from `before` to x.
template <int K>
void next_step(Operator o, const double* x, const double* before, const double* b, const double* inverse,
               double* __restrict y, std::ptrdiff_t begin, std::ptrdiff_t end, double weight, double momentum) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q)
    y[q] = x[q] + momentum * (x[q] - before[q]) + weight * inverse[q] * (b[q] - apply<K>(o, x, q));
}

template <int K>
void first_step(Operator o, const double* x, const double* b, const double* inverse, double* __restrict y,
                std::ptrdiff_t begin, std::ptrdiff_t end, double weight) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q) y[q] = x[q] + weight * inverse[q] * (b[q] - apply<K>(o, x, q));
}

// x held what y started from.
template <int K>
void second_step(Operator o, const double* y, const double* b, const double* inverse, double* __restrict x,
                 std::ptrdiff_t begin, std::ptrdiff_t end, double weight, double momentum) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q)
    x[q] = y[q] + momentum * (y[q] - x[q]) + weight * inverse[q] * (b[q] - apply<K>(o, y, q));
}

// The same, and d the step.
template <int K>
void second_step_kept(Operator o, const double* y, const double* b, const double* inverse, double* __restrict x,
                      double* __restrict d, std::ptrdiff_t begin, std::ptrdiff_t end, double weight, double momentum) {
#pragma omp simd
  for (std::ptrdiff_t q = begin; q < end; ++q) {
    const double step = momentum * (y[q] - x[q]) + weight * inverse[q] * (b[q] - apply<K>(o, y, q));
    d[q] = step;
    x[q] = y[q] + step;
  }
}

Range grown(int n, int layers) { return {filled(-layers), filled(n + 2 * layers)}; }

std::vector<Component> without_sides(std::vector<Component> components) {
  for (Component& c : components) c.sides = {};
  return components;
}

template <class F>
void for_each_cell_of(const Range& box, F&& f) {
  for_each_cell(box.lo, box.size, f);
}

// f(first, past the last place) of each contiguous piece that covers a box.
template <class F>
void for_each_slab(const Layout& layout, const Range& box, F&& f) {
  IntVec first = box.lo, last = box.lo;
  for (int a = 0; a < 2; ++a) last[a] += box.size[a] - 1;
  const int planes = DIM == 2 ? 1 : box.size[DIM - 1];
  for (int k = 0; k < planes; ++k) {
    f(layout.offset(first), layout.offset(last) + 1);
    ++first[DIM - 1];
    ++last[DIM - 1];
  }
}

}  // namespace

Multigrid::Multigrid(Hierarchy& hierarchy, std::vector<Component> components, const HierarchyField& coefficients,
                     MultigridOptions options)
    : h_(hierarchy), coefficients_(coefficients), options_(options), scalar_(components.front().normal < 0),
      x_(hierarchy, components), rhs_(hierarchy, components), step_(hierarchy, components),
      inverse_(hierarchy, without_sides(components)),
      no_drag_(static_cast<std::size_t>(hierarchy.grid(0).layout.size()), 0.0) {}

template <class F>
void Multigrid::with_operator(const HierarchyField& x, int g, int i, int c, F&& f) const {
  const Links& l = links_[at(c)];
  const Grid& grid = h_.grid(g);
  Operator o;
  o.sigma = l.sigma;
  o.drag = drag_ != nullptr ? drag_->at(g, i, c) : no_drag_.data() + grid.layout.interior();
  bool constant = true;
  for (int a = 0; a < DIM; ++a) {
    o.stride[a] = grid.layout.stride(a);
    o.factor[a] = l.along[a].factor / (grid.dx * grid.dx);
    if (l.along[a].field < 0) continue;
    constant = false;
    o.kappa[a] = coefficients_.at(g, i, l.along[a].field) - l.along[a].below * o.stride[a];
  }
  if (l.coupled) {
    for (int a = 0; a < DIM; ++a)
      if (a != c) o.other[a] = x.at(g, i, a);
    if (c == 0) f(o, std::integral_constant<int, COUPLED>{});
    if (c == 1) f(o, std::integral_constant<int, COUPLED + 1>{});
    if (DIM == 3 && c == 2) f(o, std::integral_constant<int, COUPLED + DIM - 1>{});
  } else if (constant) {
    f(o, std::integral_constant<int, CONSTANT>{});
  } else {
    f(o, std::integral_constant<int, VARIABLE>{});
  }
}

template <class F>
void Multigrid::rows(int g, const Range& box, F&& f) const {
  const Layout& layout = h_.grid(g).layout;
  for_each_row(box.size, [&](const IntVec& row) {
    IntVec q = row;
    for (int a = 0; a < DIM; ++a) q[a] += box.lo[a];
    f(layout.offset(q), box.size[0]);
  });
}

void Multigrid::prepare(std::vector<Links> links, const HierarchyField* drag) {
  links_ = std::move(links);
  drag_ = drag;
  for (int g = 0; g < h_.grids(); ++g)
    parallel_for(h_.grid(g).size(), [&](int i) {
      for (int c = 0; c < x_.components(); ++c)
        with_operator(x_, g, i, c, [&](const Operator& o, auto) {
          double* inverse = inverse_.at(g, i, c);
          rows(g, h_.unknowns(g, i, x_.component(c), false), [&](std::ptrdiff_t q0, int count) {
            for (std::ptrdiff_t q = q0; q < q0 + count; ++q) {
              double d = o.sigma + o.drag[q];
              for (int a = 0; a < DIM; ++a)
                d += (o.other[a] != nullptr ? 2 : 1) * (o.below(a, q) + o.below(a, q + o.stride[a]));
              inverse[q] = 1 / d;
            }
          });
        });
    });
  // Ghosts as their own blocks have them; 0 where a coarser leaf lies, whose values no step may change.
  for (int g = 0; g < h_.grids(); ++g) h_.exchange(inverse_, g, Layout::GHOSTS);
  if (scalar_) prepare_shares();
  prepare_bottom();
}

// Between the centres of two coarse cells lie half a link within the one, the link through the face and half a link within
// the other. What is linear in the resistance passed so far keeps the flux, whatever kappa does on the way.
void Multigrid::prepare_shares() {
  bool varies = false;
  for (const Links::Along& l : links_[0].along) varies = varies || l.field >= 0;
  if (!varies) {
    shares_ = {};
    return;
  }
  if (shares_.components() == 0) shares_ = HierarchyField(h_, std::vector<Component>(DIM));
  for (int g = 0; g + 1 < h_.grids(); ++g)
    parallel_for(h_.grid(g).size(), [&](int i) {
      const Layout& layout = h_.grid(g).layout;
      for (int a = 0; a < DIM; ++a) {
        double* share = shares_.at(g, i, a);
        const int field = links_[0].along[a].field;
        const double* kappa = field < 0 ? nullptr : coefficients_.at(g, i, field);
        const std::ptrdiff_t s = layout.stride(a);
        for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
          const std::ptrdiff_t o = layout.offset(q);
          if (kappa == nullptr) {
            share[o] = 0.25;
            return;
          }
          const bool upper = (q[a] & 1) != 0;
          const double within = kappa[upper ? o : o + s], face = kappa[upper ? o + s : o];
          double beyond = kappa[upper ? o + 2 * s : o - s];
          if (beyond == 0) beyond = face;  // a coarser leaf's
          share[o] = (0.25 / within) / (0.25 / within + 0.5 / face + 0.25 / beyond);
        });
      }
    });
}

// Whether face q of a component lies on a side of the box where it is free.
bool Multigrid::on_free_side(const Grid::Node& n, const Component& c, const IntVec& q, int cells) {
  if (c.normal < 0 || (q[c.normal] != 0 && q[c.normal] != cells)) return false;
  const int face = 2 * c.normal + (q[c.normal] != 0 ? 1 : 0);
  return n.neighbours[at(direction_index(face_offset(face)))] == Grid::OUTSIDE && !c.sides[at(face)].odd;
}

// f(node, component, face or cell, number) for the unknowns of the coarsest grid, all of which are rank 0's.
template <class F>
void Multigrid::for_bottom(F&& f) const {
  const int g = h_.grids() - 1;
  int number = 0;
  for (int i = 0; i < h_.grid(g).size(); ++i)
    for (int c = 0; c < x_.components(); ++c)
      for_each_cell_of(h_.unknowns(g, i, x_.component(c), false), [&](const IntVec& q) { f(i, c, q, number++); });
}

// Ghosts that have been filled from the numbers of the unknowns tell where the links lead, and with which sign. Half a cell
// belongs to a face on a free side: with its row halved the matrix is symmetric. The shear on such a side, through which the
// velocity along it would feel the one across it but not the other way round, is left out.
void Multigrid::prepare_bottom() {
  const int g = h_.grids() - 1;
  const Layout& layout = h_.grid(g).layout;
  x_.clear(g);
  bottom_weights_.clear();
  for_bottom([&](int i, int c, const IntVec& q, int number) {
    x_.at(g, i, c)[layout.offset(q)] = number + 1;
    bottom_weights_.push_back(on_free_side(h_.grid(g).mine(i), x_.component(c), q, layout.n) ? 0.5 : 1.0);
  });
  const int size = static_cast<int>(bottom_weights_.size());
  h_.exchange(x_, g, 1);
  if (size == 0) return;
  std::vector<SparseSolver::Entry> entries;
  for_bottom([&](int i, int c, const IntVec& place, int row) {
    const std::ptrdiff_t q = layout.offset(place);
    const auto add = [&](const double* number, std::ptrdiff_t where, double value) {
      const double k = number[where];
      if (k != 0) entries.push_back({row, static_cast<int>(std::abs(k)) - 1, bottom_weights_[at(row)] * std::copysign(value, value * k)});
    };
    with_operator(x_, g, i, c, [&](const Operator& o, auto) {
      const double* x = x_.at(g, i, c);
      add(x, q, o.sigma + o.drag[q]);
      for (int a = 0; a < DIM; ++a) {
        const std::ptrdiff_t s = o.stride[a];
        for (const int side : {0, 1}) {
          const double link = o.below(a, q + side * s);
          add(x, q, link);
          add(x, q + (2 * side - 1) * s, -link);
          IntVec edge = place;
          edge[a] += side;
          if (o.other[a] == nullptr || on_free_side(h_.grid(g).mine(i), x_.component(a), edge, layout.n)) continue;
          const double sign = side == 0 ? link : -link;
          add(o.other[a], q + side * s, sign);
          add(o.other[a], q + side * s - o.stride[c], -sign);
        }
      }
    });
  });
  bottom_size_ = size;
  if (options_.bottom == BottomSolver::hypre) {
    std::vector<HypreSolver::Entry> list;
    list.reserve(entries.size());
    // The constant that nothing may fix gets a little, as the direct solver gives it.
    for (const SparseSolver::Entry& e : entries)
      list.push_back({e.row, e.column, e.row == e.column ? e.value * (1 + SparseSolver::LIFT) : e.value});
    hypre_bottom_ = std::make_unique<HypreSolver>(MPI_COMM_SELF, 0, size, list, HypreSolver::Krylov::conjugate_gradients);
    return;
  }
  bottom_.factorize(size, entries);
}

void Multigrid::solve_bottom() {
  const int g = h_.grids() - 1;
  x_.clear(g);
  bottom_values_.resize(at(bottom_size_));
  if (bottom_size_ == 0) return;
  const Layout& layout = h_.grid(g).layout;
  for_bottom([&](int i, int c, const IntVec& q, int k) { bottom_values_[at(k)] = bottom_weights_[at(k)] * rhs_.at(g, i, c)[layout.offset(q)]; });
  if (hypre_bottom_ != nullptr) {
    const std::vector<double> b = bottom_values_;
    std::fill(bottom_values_.begin(), bottom_values_.end(), 0.0);
    hypre_bottom_->solve(b, bottom_values_, 1e-13, 100);
  } else {
    bottom_.solve(bottom_values_);
  }
  for_bottom([&](int i, int c, const IntVec& q, int k) { x_.at(g, i, c)[layout.offset(q)] = bottom_values_[at(k)]; });
}

// Chebyshev iteration with the diagonal as preconditioner, on eigenvalues from 2/lowest to 2: a few multiply-adds a
// cell and step, no colours. How many steps there will be does not matter to the first ones.
std::array<Multigrid::Step, Multigrid::MOST_STEPS> Multigrid::chebyshev() const {
  const double hi = 2.0, lo = hi / options_.lowest, theta = 0.5 * (hi + lo), delta = 0.5 * (hi - lo);
  const double sigma = theta / delta;
  std::array<Step, MOST_STEPS> steps{};
  steps[0].weight = 1 / theta;
  double rho = 1 / sigma;
  for (std::size_t k = 1; k < steps.size(); ++k) {
    const double next = 1 / (2 * sigma - rho);
    steps[k] = {2 * next / delta, next * rho};
    rho = next;
  }
  return steps;
}

// The first layer beyond free sides of the box as mirror images of x, which sweeps over that layer do not give: two velocities
// mirrored alike have no mirrored shear. And what lies on the plane beyond the last one, where no sweep gets, as `held`.
void Multigrid::close_sides(int g, int i, int c, const double* held, double* x) const {
  const Component& component = x_.component(c);
  const Grid::Node& n = h_.grid(g).mine(i);
  const Layout& layout = h_.grid(g).layout;
  const int cells = layout.n;
  for (int f = 0; f < FACES; ++f) {
    const int a = face_axis(f), beyond = n.neighbours[at(direction_index(face_offset(f)))];
    const bool normal = a == component.normal, high = face_is_high(f);
    const bool free = beyond == Grid::OUTSIDE && !component.sides[at(f)].odd;
    if (beyond >= 0 || (!free && !(normal && high))) continue;
    const int to = !high ? -1 : normal ? cells + 1 : cells, from = high ? cells - 1 : normal ? 1 : 0;
    const std::ptrdiff_t back = (from - to) * layout.stride(a);
    Range plane = grown(cells, 1);
    ++plane.size[component.normal];
    plane.lo[a] = to;
    plane.size[a] = 1;
    for_each_cell_of(plane, [&](const IntVec& q) {
      const std::ptrdiff_t p = layout.offset(q);
      x[p] = free ? x[p + back] : held[p];
    });
  }
}

// The unknowns of a component and the faces of walls: whole rows.
Range Multigrid::own(int g, int i, int c) const {
  Range r = grown(h_.grid(g).layout.n, 0);
  const int a = x_.component(c).normal;
  const Range u = h_.unknowns(g, i, x_.component(c), false);
  r.size[a] = u.lo[a] + u.size[a];
  return r;
}

namespace {

// Arrays of one node for every component, one thread's.
struct Scratch {
  std::vector<double> data;
  std::ptrdiff_t size = 0, origin = 0;
  void fit(const Layout& layout) {
    size = layout.size();
    origin = layout.interior();
    if (data.size() < static_cast<std::size_t>(size * DIM)) data.resize(static_cast<std::size_t>(size * DIM));
  }
  double* at(int c) { return data.data() + c * size + origin; }
};

// As with_operator, but the other components are those of a scratch.
template <class F>
void of_scratch(Operator o, Scratch& s, F&& f) {
  for (int a = 0; a < DIM; ++a)
    if (o.other[a] != nullptr) o.other[a] = s.at(a);
  f(o);
}

bool beside_coarser(const Grid::Node& n) {
  return std::find(n.neighbours.begin(), n.neighbours.end(), Grid::COARSER) != n.neighbours.end();
}

}  // namespace

// Three steps from zero, from the right-hand side with two layers of ghosts; then the weighted means of what they
// leave, from the result with two layers. The transpose of the interpolation, with which the cycle would be
// symmetric, spreads what stiff solids leave into the melt along faces: a disc in a corner, ratio 1e6, took twice the
// iterations.
void Multigrid::descend_in_threes(int g) {
  const auto [first, second, third] = chebyshev();
  const Layout& layout = h_.grid(g).layout;
  h_.exchange(rhs_, g, Layout::GHOSTS);
  parallel_for(h_.grid(g).size(), [&, first = first, second = second, third = third](int i) {
    thread_local Scratch one, two;
    one.fit(layout);
    two.fit(layout);
    const int components = x_.components();
    for (int c = 0; c < components; ++c) {
      const double *b = rhs_.at(g, i, c), *inverse = inverse_.at(g, i, c);
      double* y = one.at(c);
#pragma omp simd
      for (std::ptrdiff_t q = -one.origin; q < one.size - one.origin; ++q) y[q] = first.weight * inverse[q] * b[q];
    }
    for (int c = 0; c < components; ++c)
      with_operator(x_, g, i, c, [&](const Operator& whole, auto kind) {
        of_scratch(whole, one, [&](const Operator& o) {
          for_each_slab(layout, grown(layout.n, 1), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
            second_step_from_zero<decltype(kind)::value>(o, one.at(c), rhs_.at(g, i, c), inverse_.at(g, i, c),
                two.at(c), begin, end, second.weight, second.momentum);
          });
        });
        close_sides(g, i, c, one.at(c), two.at(c));
      });
    for (int c = 0; c < components; ++c)
      with_operator(x_, g, i, c, [&](const Operator& whole, auto kind) {
        of_scratch(whole, two, [&](const Operator& o) {
          for_each_slab(layout, own(g, i, c), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
            next_step<decltype(kind)::value>(o, two.at(c), one.at(c), rhs_.at(g, i, c), inverse_.at(g, i, c),
                                             x_.at(g, i, c), begin, end, third.weight, third.momentum);
          });
        });
      });
  });
  if (h_.leaves_from(g + 1)) meet_coarser(g);
  h_.exchange(x_, g, Layout::GHOSTS);
  h_.restrict_weighted([&](int i) { return residual_round(g, i); }, rhs_, g);
}

// What x_ leaves of one node, on the plane of faces below it as well: another node's, or as the first one's.
Array<ArrayRef<const double>> Multigrid::residual_round(int g, int i) const {
  thread_local Scratch left;
  const Layout& layout = h_.grid(g).layout;
  left.fit(layout);
  Array<ArrayRef<const double>> result{};
  for (int c = 0; c < x_.components(); ++c) {
    double* r = left.at(c);
    const int normal = x_.component(c).normal;
    Range box = own(g, i, c);
    --box.lo[normal];
    ++box.size[normal];
    with_operator(x_, g, i, c, [&](const Operator& o, auto kind) {
      for_each_slab(layout, box, [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
        residual_sweep<decltype(kind)::value>(o, x_.at(g, i, c), rhs_.at(g, i, c), r, begin, end);
      });
    });
    result[c] = array_ref(static_cast<const double*>(r), layout);
    IntVec below{};
    below[normal] = -1;
    if (h_.grid(g).mine(i).neighbours[at(direction_index(below))] >= 0) continue;
    box.size[normal] = 1;
    for_each_cell_of(box, [&](const IntVec& q) { r[layout.offset(q)] = r[layout.offset(q) + layout.stride(normal)]; });
  }
  return result;
}

// The same three steps after the correction.
void Multigrid::ascend_in_threes(int g) {
  const auto [first, second, third] = chebyshev();
  const Layout& layout = h_.grid(g).layout;
  const int components = x_.components();
  h_.exchange(x_, g + 1, Layout::GHOSTS);
  h_.prolong_add(x_, g);
  h_.exchange(x_, g, Layout::GHOSTS);
  parallel_for(h_.grid(g).size(), [&, first = first, second = second](int i) {
    thread_local Scratch one;
    one.fit(layout);
    for (int c = 0; c < components; ++c)
      with_operator(x_, g, i, c, [&](const Operator& o, auto kind) {
        for_each_slab(layout, grown(layout.n, 1), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
          first_step<decltype(kind)::value>(o, x_.at(g, i, c), rhs_.at(g, i, c), inverse_.at(g, i, c), one.at(c),
              begin, end, first.weight);
        });
        close_sides(g, i, c, x_.at(g, i, c), one.at(c));
      });
    for (int c = 0; c < components; ++c)
      with_operator(x_, g, i, c, [&](const Operator& whole, auto kind) {
        of_scratch(whole, one, [&](const Operator& o) {
          for_each_slab(layout, own(g, i, c), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
            second_step_kept<decltype(kind)::value>(o, one.at(c), rhs_.at(g, i, c), inverse_.at(g, i, c),
                                                    x_.at(g, i, c), step_.at(g, i, c), begin, end, second.weight, second.momentum);
          });
        });
      });
  });
  h_.exchange(x_, g, 1);
  parallel_for(h_.grid(g).size(), [&, third = third](int i) {
    for (int c = 0; c < components; ++c)
      with_operator(x_, g, i, c, [&](const Operator& o, auto kind) {
        for_each_slab(layout, own(g, i, c), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
          chebyshev_step<decltype(kind)::value>(o, x_.at(g, i, c), rhs_.at(g, i, c), inverse_.at(g, i, c), step_.at(g,
              i, c), begin, end, third.weight, third.momentum);
        });
      });
    for (int c = 0; c < components; ++c) {  // after all: components may be coupled
      double* x = x_.at(g, i, c);
      const double* d = step_.at(g, i, c);
      for_each_slab(layout, own(g, i, c), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
#pragma omp simd
        for (std::ptrdiff_t q = begin; q < end; ++q) x[q] += d[q];
      });
    }
  });
}

// rhs_ -= A step_ on the leaves of grid g beside finer ones.
void Multigrid::correct_border(int g) {
  const Grid& grid = h_.grid(g);
  parallel_for(grid.size(), [&](int i) {
    const Grid::Node& n = grid.mine(i);
    if (n.leaf < 0) return;
    bool border = false;
    for (const int m : n.neighbours) border = border || (m >= 0 && grid.nodes[at(m)].leaf < 0);
    if (!border) return;
    for (int c = 0; c < x_.components(); ++c)
      with_operator(step_, g, i, c, [&](const Operator& o, auto kind) {
        const double* x = step_.at(g, i, c);
        double* r = rhs_.at(g, i, c);
        rows(g, h_.unknowns(g, i, x_.component(c), true), [&](std::ptrdiff_t q0, int count) {
#pragma omp simd
          for (std::ptrdiff_t q = q0; q < q0 + count; ++q) r[q] -= apply<decltype(kind)::value>(o, x, q);
        });
      });
  });
}

// What grid g has found as leaves of grid g+1 see it: as means, in step_, where the leaves hold zero. Ghosts of grid g beside
// those leaves are interpolated from both. With ghosts of zero a cycle leaves half of the error on planes of faces that coarser
// leaves share, and a seventh everywhere else.
void Multigrid::meet_coarser(int g) {
  step_.clear(g + 1);
  h_.restrict_means(x_, step_, g);
  h_.exchange(step_, g + 1, Layout::GHOSTS);
  h_.fill_from_coarser(step_, x_, g);
}

// Two steps from zero and the means of what they leave, all from the right-hand side with two layers of ghosts.
void Multigrid::descend_in_pairs(int g) {
  const auto [first, second, third] = chebyshev();
  const Layout& layout = h_.grid(g).layout;
  h_.exchange(rhs_, g, Layout::GHOSTS);
  const auto steps = [&, first = first, second = second](int i) {
    thread_local std::vector<double> one_array, left_array;
    one_array.resize(static_cast<std::size_t>(h_.grid(0).layout.size()));
    left_array.resize(one_array.size());
    double *one = one_array.data() + layout.interior(), *left = left_array.data() + layout.interior();
    double* x = x_.at(g, i, 0);
    if (beside_coarser(h_.grid(g).mine(i))) std::fill_n(x - layout.interior(), layout.size(), 0.0);
    const double *b = rhs_.at(g, i, 0), *inverse = inverse_.at(g, i, 0);
    with_operator(x_, g, i, 0, [&](const Operator& o, auto kind) {
      constexpr int K = decltype(kind)::value;
      for_each_slab(layout, grown(layout.n, 2), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
#pragma omp simd
        for (std::ptrdiff_t q = begin; q < end; ++q) one[q] = first.weight * inverse[q] * b[q];
      });
      for_each_slab(layout, grown(layout.n, 1), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
        second_step_from_zero<K>(o, one, b, inverse, x, begin, end, second.weight, second.momentum);
      });
      for_each_slab(layout, grown(layout.n, 0), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
        residual_sweep<K>(o, x, b, left, begin, end);
      });
    });
    return array_ref(static_cast<const double*>(left), layout);
  };
  h_.restrict_made(steps, rhs_, g);
}

void Multigrid::ascend_in_pairs(int g) {
  const auto [first, second, third] = chebyshev();
  const Layout& layout = h_.grid(g).layout;
  h_.exchange(x_, g + 1, Layout::GHOSTS);
  if (shares_.components() > 0) {
    h_.prolong_add_shared(x_, shares_, g);
  } else {
    h_.prolong_add(x_, g);
  }
  h_.exchange(x_, g, Layout::GHOSTS);
  parallel_for(h_.grid(g).size(), [&, first = first, second = second](int i) {
    thread_local std::vector<double> one_array;
    one_array.resize(static_cast<std::size_t>(h_.grid(0).layout.size()));
    double *one = one_array.data() + layout.interior(), *x = x_.at(g, i, 0);
    const double *b = rhs_.at(g, i, 0), *inverse = inverse_.at(g, i, 0);
    with_operator(x_, g, i, 0, [&](const Operator& o, auto kind) {
      constexpr int K = decltype(kind)::value;
      for_each_slab(layout, grown(layout.n, 1), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
        first_step<K>(o, x, b, inverse, one, begin, end, first.weight);
      });
      for_each_slab(layout, grown(layout.n, 0), [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
        second_step<K>(o, one, b, inverse, x, begin, end, second.weight, second.momentum);
      });
    });
  });
}

// step_ for leaves of grid g+1 such that what leaves them is what enters the finer nodes.
void Multigrid::match_border(int g) {
  Array<int> kappa{};
  for (int a = 0; a < DIM; ++a) kappa[a] = links_[0].along[a].field;
  h_.match_fluxes(x_, step_, g, coefficients_, kappa);
}

void Multigrid::cycle() {
  const int last = h_.grids() - 1;
  for (int g = 0; g < last; ++g) {
    if (scalar_) {
      descend_in_pairs(g);
    } else {
      descend_in_threes(g);
    }
    if (!h_.leaves_from(g + 1)) continue;
    if (scalar_) match_border(g);
    correct_border(g + 1);
  }
  solve_bottom();
  for (int g = last - 1; g >= 0; --g) {
    if (scalar_) {
      ascend_in_pairs(g);
    } else {
      ascend_in_threes(g);
    }
  }
}

}  // namespace dendrift::amr

#include "amr/scalar_solver.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace dendrift::amr {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

std::vector<Component> faces_of_all_axes() {
  std::vector<Component> list(DIM);
  for (int a = 0; a < DIM; ++a) list[at(a)].normal = a;
  return list;
}

struct Coefficients {
  Array<const double*> beta{};
  Array<std::ptrdiff_t> stride{};
  double sigma = 0, factor = 1;  // of beta, over dx^2
};

template <bool VARIABLE>
[[gnu::always_inline]] inline double stencil(const Coefficients& k, const double* x, std::ptrdiff_t q) {
  double sum = 0;
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = k.stride[a];
    if constexpr (VARIABLE) {
      sum += k.beta[a][q] * (x[q] - x[q - s]) + k.beta[a][q + s] * (x[q] - x[q + s]);
    } else {
      sum += (x[q] - x[q - s]) + (x[q] - x[q + s]);
    }
  }
  return k.sigma * x[q] + k.factor * sum;
}

template <bool VARIABLE>
void product_row(Coefficients k, const double* x, int n, double* __restrict y) {
#pragma omp simd
  for (int q = 0; q < n; ++q) y[q] = stencil<VARIABLE>(k, x, q);
}

template <bool VARIABLE>
void residual_row(Coefficients k, const double* x, const double* b, int n, double* __restrict y) {
#pragma omp simd
  for (int q = 0; q < n; ++q) y[q] = b[q] - stencil<VARIABLE>(k, x, q);
}

// y += sign extra x
void add_extra_row(const double* extra, const double* x, int n, double sign, double* __restrict y) {
#pragma omp simd
  for (int q = 0; q < n; ++q) y[q] += sign * extra[q] * x[q];
}

}  // namespace

ScalarSolver::ScalarSolver(const Mesh& mesh, const std::array<MirrorRule, FACES>& sides, const ScalarOptions& options)
    : options_(options), mesh_(mesh), hierarchy_(mesh), state_(hierarchy_, {Component{-1, sides}}),
      rhs_(hierarchy_, {Component{-1, sides}}), beta_(hierarchy_, faces_of_all_axes()), extra_(hierarchy_, {Component{}}),
      cycle_(hierarchy_, {Component{-1, sides}}, beta_, options.cycle) {
  if (options.method == ScalarMethod::hypre && !HypreSolver::available()) throw std::runtime_error("this build has no hypre");
  volumes_.comm = mesh.comm();
  volumes_.alike = true;
  const std::ptrdiff_t cells = volume(filled(mesh.layout().n));
  const double finest = hierarchy_.grid(0).dx;
  for (int b = 0; b < mesh.size(); ++b) {
    volumes_.first.push_back((b + 1) * cells);
    volumes_.weight.insert(volumes_.weight.end(), static_cast<std::size_t>(cells), std::pow(mesh.block(b).dx / finest, DIM));
  }
  pieces_ = volumes_;
  gcr_.precondition = [this](const Vector& r, Vector& z) {
    unpack(r, cycle_.rhs());
    cycle_.cycle();
    pack(cycle_.solution(), z);
  };
  gcr_.apply = [this](const Vector&, Vector& w) { apply(cycle_.solution(), true, nullptr, w); };
}

void ScalarSolver::prepare(double sigma, double beta) {
  Links links;
  for (int a = 0; a < DIM; ++a) {
    links.along[a].factor = beta;
    kappa_[a] = -1;
  }
  factor_ = beta;
  with_extra_ = false;
  prepare_links(sigma, links);
}

void ScalarSolver::prepare(double sigma) {
  with_extra_ = false;
  prepare_beta(sigma);
}

void ScalarSolver::prepare_with_extra(double sigma) {
  with_extra_ = true;
  for (int g = 0; g < hierarchy_.grids(); ++g) {
    hierarchy_.exchange(extra_, g, Layout::GHOSTS);
    if (g + 1 < hierarchy_.grids()) hierarchy_.restrict_means(extra_, extra_, g);
  }
  prepare_beta(sigma);
}

void ScalarSolver::prepare_beta(double sigma) {
  spread_beta();
  Links links;
  for (int a = 0; a < DIM; ++a) links.along[a].field = kappa_[a] = a;
  factor_ = 1;
  prepare_links(sigma, links);
}

void ScalarSolver::prepare_links(double sigma, const Links& links) {
  sigma_ = sigma;
  floating_ = sigma == 0 && !with_extra_;
  for (int f = 0; f < FACES; ++f)
    if (mesh_.shape().sides[at(f)] != Side::periodic && state_.component(0).sides[at(f)].odd) floating_ = false;
  Links all = links;
  all.sigma = sigma;
  cycle_.prepare({all}, with_extra_ ? &extra_ : nullptr);
  weigh();
  if (options_.method == ScalarMethod::hypre) assemble();
}

// Residuals over the diagonal: a small error where beta is large would hide what is left everywhere else.
void ScalarSolver::weigh() {
  pieces_.alike = kappa_[0] < 0;
  pieces_.weight = volumes_.weight;
  if (pieces_.alike) return;
  parallel_for(mesh_.size(), [&](int b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    const Layout& layout = mesh_.layout();
    const double over = 1 / (mesh_.block(b).dx * mesh_.block(b).dx);
    double* w = pieces_.weight.data() + pieces_.first[at(b)];
    for_each_cell({}, filled(layout.n), [&, g = g, i = i](const IntVec& q) {
      const std::ptrdiff_t o = layout.offset(q);
      double links = 0;
      for (int a = 0; a < DIM; ++a) links += beta_.at(g, i, a)[o] + beta_.at(g, i, a)[o + layout.stride(a)];
      *w++ /= zeroth(g, i, o) + over * links;
    });
  });
}

// Parents conduct as their finer faces do together; all nodes get two layers beyond their sides.
void ScalarSolver::spread_beta() {
  for (int g = 0; g + 1 < hierarchy_.grids(); ++g) {
    hierarchy_.exchange(beta_, g, 1);
    hierarchy_.restrict_links(beta_, g);
  }
  for (int g = 0; g < hierarchy_.grids(); ++g) hierarchy_.exchange(beta_, g, Layout::GHOSTS);
}

// What every leaf sees round it, with fluxes that agree where levels meet.
void ScalarSolver::fill(HierarchyField& f, bool homogeneous) {
  hierarchy_.make_composite(f, 1, homogeneous, false);
  for (int g = 0; hierarchy_.leaves_from(g + 1); ++g) hierarchy_.match_fluxes(f, f, g, beta_, kappa_);
}

void ScalarSolver::apply(HierarchyField& x, bool homogeneous, const HierarchyField* rhs, Vector& y) {
  fill(x, homogeneous);
  y.resize(pieces_.size());
  parallel_for(mesh_.size(), [&](int b) {
    const Hierarchy::Place place = hierarchy_.place_of_block(b);  // clang 14 captures no structured bindings
    const int g = place.grid, i = place.node;
    const Grid& grid = hierarchy_.grid(g);
    Coefficients k;
    k.sigma = sigma_;
    k.factor = factor_ / (grid.dx * grid.dx);
    for (int a = 0; a < DIM; ++a) k.stride[a] = grid.layout.stride(a);
    const double *from = x.at(g, i, 0), *f = rhs == nullptr ? nullptr : rhs->at(g, i, 0);
    double* to = y.data() + pieces_.first[at(b)];
    const int n = grid.layout.n;
    for_each_row(filled(n), [&](const IntVec& row) {
      const std::ptrdiff_t q = grid.layout.offset(row);
      if (kappa_[0] < 0) {
        f == nullptr ? product_row<false>(k, from + q, n, to) : residual_row<false>(k, from + q, f + q, n, to);
      } else {
        for (int a = 0; a < DIM; ++a) k.beta[a] = beta_.at(g, i, a) + q;
        f == nullptr ? product_row<true>(k, from + q, n, to) : residual_row<true>(k, from + q, f + q, n, to);
      }
      if (with_extra_) add_extra_row(extra_.at(g, i, 0) + q, from + q, n, f == nullptr ? 1 : -1, to);
      to += n;
    });
  });
}

void ScalarSolver::pack(const HierarchyField& f, Vector& v) const {
  v.resize(pieces_.size());
  parallel_for(mesh_.size(), [&](int b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    const IntVec size = filled(mesh_.layout().n);
    copy_box(packed_ref(v.data() + pieces_.first[at(b)], size), {}, f.ref(g, i, 0), {}, size);
  });
}

void ScalarSolver::unpack(const Vector& v, HierarchyField& f) const {
  parallel_for(mesh_.size(), [&](int b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    const IntVec size = filled(mesh_.layout().n);
    copy_box(f.ref(g, i, 0), {}, packed_ref(v.data() + pieces_.first[at(b)], size), {}, size);
  });
}

void ScalarSolver::remove_mean(Vector& v) const {
  if (!floating_) return;
  const Vector one(v.size(), 1.0);
  const std::vector<Vector> with{v, one};
  const std::vector<double> p = volumes_.products(one, with);
  const double mean = p[0] / p[1];
  for (double& q : v) q -= mean;
}

double ScalarSolver::largest(const Vector& v) const {
  double most = 0;
  for (const double q : v) most = std::max(most, std::abs(q));
  return global_max(most, mesh_.comm());
}

// Largest diagonal entry times x times the spacing of doubles.
double ScalarSolver::rounding(const Vector& x) const {
  double most = 0;
  for (int b = 0; b < mesh_.size(); ++b) {
    const Hierarchy::Place place = hierarchy_.place_of_block(b);  // clang 14 captures no structured bindings
    const int g = place.grid, i = place.node;
    const Layout& layout = mesh_.layout();
    const double over = factor_ / (mesh_.block(b).dx * mesh_.block(b).dx);
    const double* p = x.data() + pieces_.first[at(b)];
    for_each_row(filled(layout.n), [&](const IntVec& row) {
      const std::ptrdiff_t o = layout.offset(row);
      for (int q = 0; q < layout.n; ++q, ++p) {
        double links = 2 * DIM;
        if (kappa_[0] >= 0) {
          links = 0;
          for (int a = 0; a < DIM; ++a) links += beta_.at(g, i, a)[o + q] + beta_.at(g, i, a)[o + q + layout.stride(a)];
        }
        most = std::max(most, (zeroth(g, i, o + q) + over * links) * std::abs(*p));
      }
    });
  }
  return std::numeric_limits<double>::epsilon() * global_max(most, mesh_.comm());
}

ScalarResult ScalarSolver::solve() {
  Vector x, r, b;
  pack(rhs_, b);
  remove_mean(b);
  if (floating_) unpack(b, rhs_);
  // What sides with values force is measured as well: f may be 0.
  bool forced = false;
  for (const MirrorRule& s : state_.component(0).sides)
    forced = forced || (s.odd && !(s.value.uniform() && s.value.constant == 0));
  pack(state_, x);
  if (forced) {
    unpack(Vector(x.size(), 0.0), state_);
    apply(state_, false, &rhs_, b);
    unpack(x, state_);
  }
  const double norm = volumes_.norm(b), weighted = pieces_.norm(b), most = largest(b);
  ScalarResult result;
  if (norm == 0) {
    unpack(Vector(x.size(), 0.0), state_);
    fill(state_, false);
    result.converged = true;
    return result;
  }
  // A second pass begins from the residual computed anew, where round-off has parted it from the one carried along.
  constexpr int PASSES = 4;
  for (int pass = 0; pass <= PASSES; ++pass) {
    apply(state_, false, &rhs_, r);
    result.residual = volumes_.norm(r) / norm;
    result.largest = largest(r) / most;
    result.rounding = rounding(x) / most;
    const double enough = std::max(options_.tolerance, result.rounding);
    result.converged = result.residual <= enough && result.largest <= enough;
    if (result.converged || pass == PASSES || result.iterations >= options_.max_iterations) break;
    if (options_.method == ScalarMethod::hypre) {
      result.iterations += solve_by_hypre(x, r);
    } else {
      GcrOptions o;
      // A little less, for the round-off of carrying it; later much less, where its norm, weighted with the diagonal, has
      // been content too early.
      o.tolerance = 0.95 * std::pow(0.3, pass) * options_.tolerance;
      o.max_iterations = options_.max_iterations - result.iterations;
      o.directions = options_.directions;
      result.iterations += gcr_.solve(x, r, pieces_, o, weighted, most).iterations;
    }
    unpack(x, state_);
  }
  if (floating_) {
    remove_mean(x);
    unpack(x, state_);
    fill(state_, false);
  }
  return result;
}

namespace {

// Which leaves' cells, with which weights, make up the value in a cell of any level: its own, the mean of finer ones, or
// the interpolation between coarser ones; beyond a side its mirror image. It shares nothing with the exchange of ghosts.
class Expansion {
 public:
  Expansion(const Mesh& mesh, const std::array<MirrorRule, FACES>& sides, const std::vector<std::int64_t>& first)
      : mesh_(mesh), sides_(sides), first_(first) {}

  template <class F>
  void operator()(int level, IntVec cell, double weight, F&& add) const {
    const int n = mesh_.layout().n;
    const Tree& tree = mesh_.tree();
    BlockIndex node{level, {}};
    for (int a = 0; a < DIM; ++a) {
      const int extent = (tree.root_blocks()[a] << level) * n;
      if (tree.periodic()[a]) {
        cell[a] = (cell[a] + extent) % extent;
      } else if (cell[a] < 0 || cell[a] >= extent) {
        const bool high = cell[a] >= extent;
        cell[a] = high ? 2 * extent - 1 - cell[a] : -1 - cell[a];
        if (sides_[at(2 * a + (high ? 1 : 0))].odd) weight = -weight;
      }
      node.coord[a] = cell[a] / n;
    }
    const int leaf = tree.locate(node);
    const int found = tree.leaf(leaf).level;
    if (found == level) {
      std::int64_t place = 0;
      for (int a = DIM - 1; a >= 0; --a) place = place * n + cell[a] % n;
      add(first_[at(leaf)] + place, weight);
    } else if (found > level) {
      for (int child = 0; child < CHILDREN; ++child) {
        IntVec fine{};
        for (int a = 0; a < DIM; ++a) fine[a] = 2 * cell[a] + (child >> a & 1);
        (*this)(level + 1, fine, weight / CHILDREN, add);
      }
    } else {
      Array<double> side{};
      for (int a = 0; a < DIM; ++a) side[a] = (cell[a] & 1) != 0 ? 1 : -1;
      for (int d = 0; d < DIRECTIONS; ++d) {
        std::array<double, DIRECTIONS> unit{};
        unit[at(d)] = 1;
        const double w = child_value(unit.data() + CENTRE, packed_ref(unit.data(), filled(3)).stride, side);
        if (w == 0) continue;
        IntVec coarse{};
        for (int a = 0; a < DIM; ++a) coarse[a] = (cell[a] >> 1) + direction_offset(d)[a];
        (*this)(level - 1, coarse, weight * w, add);
      }
    }
  }

 private:
  const Mesh& mesh_;
  const std::array<MirrorRule, FACES>& sides_;
  const std::vector<std::int64_t>& first_;
};

}  // namespace

// Rows times volumes: symmetric but for the interpolation where levels meet. Fluxes between levels are added to both rows
// by the owner of the finer cell.
void ScalarSolver::assemble() {
  const Tree& tree = mesh_.tree();
  const int n = mesh_.layout().n;
  const std::int64_t cells = volume(filled(n));
  std::vector<std::int64_t> first(at(tree.size()));
  std::int64_t next = 0, mine = 0;
  for (int rank = 0; rank < mesh_.ranks(); ++rank) {
    if (rank == mesh_.rank()) mine = next;
    for (int leaf = 0; leaf < tree.size(); ++leaf) {
      if (mesh_.owner(leaf) != rank) continue;
      first[at(leaf)] = next;
      next += cells;
    }
  }
  const Expansion expand(mesh_, state_.component(0).sides, first);
  std::vector<HypreSolver::Entry> entries;
  bool several_levels = false;
  for (int leaf = 0; leaf < tree.size(); ++leaf) several_levels = several_levels || tree.leaf(leaf).level != tree.leaf(0).level;
  for (int b = 0; b < mesh_.size(); ++b) {
    const Hierarchy::Place place = hierarchy_.place_of_block(b);  // clang 14 captures no structured bindings
    const int g = place.grid, i = place.node;
    const Block& block = mesh_.block(b);
    const double cell = std::pow(block.dx, DIM), link = std::pow(block.dx, DIM - 2) * factor_;
    for_each_cell({}, filled(n), [&](const IntVec& q) {
      std::int64_t row = first[at(block.leaf)];
      std::int64_t stride = 1;
      IntVec global{};
      for (int a = 0; a < DIM; ++a, stride *= n) {
        row += q[a] * stride;
        global[a] = block.index.coord[a] * n + q[a];
      }
      // The direct solver's little something where the constant is free.
      double diagonal = zeroth(g, i, mesh_.layout().offset(q)) * cell;
      for (int f = 0; f < FACES; ++f) {
        const int a = face_axis(f);
        IntVec beyond = global, face = q;
        beyond[a] += face_offset(f)[a];
        if (face_is_high(f)) ++face[a];
        const double k = link * (kappa_[a] < 0 ? 1.0 : beta_.at(g, i, a)[mesh_.layout().offset(face)]);
        const bool inside = q[a] + face_offset(f)[a] >= 0 && q[a] + face_offset(f)[a] < n;
        const Neighbour across = inside ? Neighbour{Neighbour::Kind::same, block.leaf}
                                        : tree.neighbour(block.leaf, direction_index(face_offset(f)));
        if (across.kind == Neighbour::Kind::finer) continue;
        diagonal += k;
        expand(block.index.level, beyond, -k, [&](std::int64_t c, double w) { entries.push_back({row, c, w}); });
        if (across.kind != Neighbour::Kind::coarser) continue;
        std::int64_t other = 0;
        IntVec coarse = beyond;
        for (int d = 0; d < DIM; ++d) {
          const int extent = (tree.root_blocks()[d] << block.index.level) * n;
          coarse[d] = ((beyond[d] + extent) % extent) >> 1;
        }
        for (int d = DIM - 1; d >= 0; --d) other = other * n + coarse[d] % n;
        other += first[at(across.leaf)];
        entries.push_back({other, row, -k});
        expand(block.index.level, beyond, k, [&](std::int64_t c, double w) { entries.push_back({other, c, w}); });
      }
      if (floating_) diagonal *= 1 + SparseSolver::LIFT;
      entries.push_back({row, row, diagonal});
    });
  }
  hypre_ = std::make_unique<HypreSolver>(mesh_.comm(), mine, mesh_.size() * cells, entries,
                                         several_levels ? HypreSolver::Krylov::gmres
                                                        : HypreSolver::Krylov::conjugate_gradients);
}

// x += what hypre finds for the residual r.
int ScalarSolver::solve_by_hypre(Vector& x, const Vector& r) {
  Vector b(r.size()), change(r.size(), 0.0);
  for (int block = 0; block < mesh_.size(); ++block) {
    const double cell = std::pow(mesh_.block(block).dx, DIM);
    for (std::ptrdiff_t q = pieces_.first[at(block)]; q < pieces_.first[at(block) + 1]; ++q)
      b[static_cast<std::size_t>(q)] = cell * r[static_cast<std::size_t>(q)];
  }
  const int iterations = hypre_->solve(b, change, 0.1 * options_.tolerance, options_.max_iterations);
  for (std::size_t q = 0; q < x.size(); ++q) x[q] += change[q];
  return iterations;
}

}  // namespace dendrift::amr

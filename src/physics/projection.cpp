// Incremental pressure correction on the hierarchy: the cheap way of StokesSolver.
#include <algorithm>
#include <cmath>
#include <limits>

#include "physics/stokes.hpp"

namespace dendrift::physics {

using amr::HierarchyField;
using amr::Layout;
using amr::Range;

namespace {
std::size_t at(int i) { return static_cast<std::size_t>(i); }
}  // namespace

// v -= factor * grad p on the unknown faces of the leaves, times sigma/(sigma + kappa) where there is drag: a push of the
// pressure moves melt, and not the solid that resists it. Ghosts of p are filled.
void StokesSolver::subtract_gradient(const HierarchyField& p, double factor, HierarchyField& v) const {
  for_leaves([&](int, int g, int i, double dx) {
    const Layout& layout = hierarchy_.grid(g).layout;
    const double* from = p.at(g, i, 0);
    for (int a = 0; a < DIM; ++a) {
      double* to = v.at(g, i, a);
      const double* mobility = drag_ != nullptr ? mobility_->at(g, i, a) : nullptr;
      const Range r = hierarchy_.unknowns(g, i, components_[at(a)], true);
      amr::for_each_cell(r.lo, r.size, [&](const IntVec& q) {
        const std::ptrdiff_t o = layout.offset(q);
        const double share = mobility != nullptr ? sigma_ * mobility[o] : 1.0;
        to[o] -= factor * share / dx * (from[o] - from[o - layout.stride(a)]);
      });
    }
  });
}

void StokesSolver::cycle_momentum(HierarchyField& r) {
  for_leaves([&](int, int g, int i, double) {
    std::fill_n(pressure_.at(g, i, 0) - mesh_.layout().interior(), mesh_.layout().size(), 0.0);
  });
  cycle_velocity(r);
}

// Largest diagonal entry times v times the spacing of doubles.
double StokesSolver::rounding_of_momentum() const {
  double most = 0;
  for (int b = 0; b < mesh_.size(); ++b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    const double *nu = viscosity_.at(g, i, 0), over = 4.0 * DIM / (mesh_.block(b).dx * mesh_.block(b).dx);
    for (int a = 0; a < DIM; ++a) {
      const double *v = state_.at(g, i, a), *kappa = drag_ != nullptr ? drag_->at(g, i, a) : nullptr;
      amr::for_each_cell({}, filled(mesh_.layout().n), [&](const IntVec& q) {
        const std::ptrdiff_t o = mesh_.layout().offset(q);
        most = std::max(most, (sigma_ + over * nu[o] + (kappa != nullptr ? kappa[o] : 0.0)) * std::abs(v[o]));
      });
    }
  }
  return std::numeric_limits<double>::epsilon() * amr::global_max(most, mesh_.comm());
}

StokesResult StokesSolver::solve_momentum(double sigma) {
  sigma_ = sigma;
  velocity_cycle_->prepare(velocity_links(sigma), drag_.get());
  // Vectors of velocities alone, piece by piece what pack() puts before the pressures.
  const std::ptrdiff_t cells = volume(filled(mesh_.layout().n));
  amr::Pieces pieces;
  pieces.comm = mesh_.comm();
  for (int b = 0; b < mesh_.size(); ++b) {
    const auto begin = pieces_.weight.begin();
    pieces.weight.insert(pieces.weight.end(), begin + pieces_.first[at(b)], begin + (pieces_.first[at(b) + 1] - cells));
    pieces.first.push_back(static_cast<std::ptrdiff_t>(pieces.weight.size()));
  }
  pieces.alike = true;
  const auto for_rows = [&](auto&& f) {
    for_leaves([&](int b, int g, int i, double) {
      std::ptrdiff_t place = pieces.first[at(b)];
      for (int a = 0; a < DIM; ++a) {
        const Range r = hierarchy_.unknowns(g, i, components_[at(a)], true);
        amr::for_each_row(r.size, [&](const IntVec& row) {
          f(g, i, a, mesh_.layout().offset(r.lo) + mesh_.layout().offset(row), place, r.size[0]);
          place += r.size[0];
        });
      }
    });
  };
  const auto take = [&](const HierarchyField& f, Vector& v) {
    v.resize(pieces.size());
    for_rows([&](int g, int i, int a, std::ptrdiff_t from, std::ptrdiff_t to, int count) {
      std::copy_n(f.at(g, i, a) + from, count, v.data() + to);
    });
  };
  const auto put = [&](const Vector& v, HierarchyField& f) {
    for_rows([&](int g, int i, int a, std::ptrdiff_t to, std::ptrdiff_t from, int count) {
      std::copy_n(v.data() + from, count, f.at(g, i, a) + to);
    });
  };
  Vector zero;
  pack(work_, zero);
  std::fill(zero.begin(), zero.end(), 0.0);
  unpack(zero, work_);  // its pressures
  amr::Gcr gcr;
  gcr.precondition = [&](const Vector& r, Vector& z) {
    put(r, image_);
    cycle_momentum(image_);
    take(image_, z);
  };
  gcr.apply = [&](const Vector& z, Vector& w) {
    put(z, work_);
    hierarchy_.make_composite(work_, 1, true, false);
    apply(work_, nullptr, image_);
    take(image_, w);
  };
  const auto residual = [&](const Vector& of, Vector& left) {
    put(of, state_);
    hierarchy_.make_composite(state_, 1, false);
    apply(state_, &force_, image_);
    take(image_, left);
  };
  const auto largest = [&](const Vector& v) {
    double most = 0;
    for (const double q : v) most = std::max(most, std::abs(q));
    return amr::global_max(most, mesh_.comm());
  };
  Vector x, r, b;
  take(state_, x);
  residual(Vector(x.size(), 0.0), b);  // what sides and pressure force as well
  const double norm = std::max(pieces.norm(b), 1e-300), most = std::max(largest(b), 1e-300);
  StokesResult result;
  constexpr int PASSES = 3, DIRECTIONS_KEPT = 16;
  for (int pass = 0; pass <= PASSES; ++pass) {
    residual(x, r);
    result.error = std::max(pieces.norm(r) / norm, largest(r) / most);
    result.converged = result.error <= std::max(options_.tolerance, rounding_of_momentum() / most);
    if (result.converged || pass == PASSES || result.iterations >= options_.max_iterations) break;
    const amr::GcrOptions o{.tolerance = 0.95 * options_.tolerance,
                            .max_iterations = options_.max_iterations - result.iterations,
                            .directions = DIRECTIONS_KEPT};
    result.iterations += gcr.solve(x, r, pieces, o, norm, most).iterations;
  }
  fill_state();
  return result;
}

StokesResult StokesSolver::project(Vector& x) {
  momentum_.residual = [this](const Vector& now, Vector& r) {
    gmres_.residual(now, r);
    blank(r, true);
  };
  momentum_.apply = [this](const Vector& v, Vector& w) {
    gmres_.apply(v, w);
    blank(w, true);
  };
  momentum_.precondition = [this](Vector& r) {
    unpack(r, image_);
    cycle_momentum(image_);
    pack(image_, r);
    blank(r, true);
  };
  // -div [sigma/(sigma + kappa)] grad phi = -sigma div v, the gradient put together over the levels before its divergence is taken.
  poisson_.apply = [this](const Vector& v, Vector& w) {
    unpack(v, work_);
    for_leaves([&](int, int g, int i, double) {
      amr::copy_box(pressure_.ref(g, i, 0), {}, std::as_const(work_).ref(g, i, PRESSURE), {}, filled(mesh_.layout().n));
      for (int a = 0; a < DIM; ++a) std::fill_n(work_.at(g, i, a) - mesh_.layout().interior(), mesh_.layout().size(), 0.0);
    });
    hierarchy_.make_composite(pressure_, 1, true);
    subtract_gradient(pressure_, 1, work_);
    hierarchy_.make_composite(work_, 1, true);
    apply(work_, nullptr, image_);
    pack(image_, w);
    blank(w, false);
  };
  poisson_.precondition = [this](Vector& r) {
    unpack(r, image_);
    cycle_pressure(image_);
    for_leaves([&](int, int g, int i, double) {
      const double* from = pressure_cycle_->solution().at(g, i, 0);
      double* to = image_.at(g, i, PRESSURE);
      amr::for_each_cell({}, filled(mesh_.layout().n), [&](const IntVec& q) {
        const std::ptrdiff_t o = mesh_.layout().offset(q);
        to[o] = drag_ != nullptr ? from[o] / sigma_ : from[o];  // its mobility lacks the sigma
      });
    });
    remove_mean_pressure(image_);
    pack(image_, r);
    blank(r, false);
  };
  StokesResult result;
  result.converged = true;
  for (int pass = 0; pass < options_.passes; ++pass) project_pass(x, result);
  Vector r;
  gmres_.residual(x, r);
  gmres_.precondition(r);
  result.error = pieces_.norm(r);
  return result;
}

void StokesSolver::project_pass(Vector& x, StokesResult& result) {
  amr::GmresOptions o;
  o.max_iterations = options_.max_iterations;
  o.tolerance = options_.tolerance;
  const amr::GmresResult m = momentum_.solve(x, pieces_, o, [this](const Vector& now) { return size(now); });

  unpack(x, state_);
  hierarchy_.make_composite(state_, 1, false);
  apply(state_, nullptr, image_);
  Vector divergence;
  pack(image_, divergence);
  blank(divergence, false);

  const amr::Pieces plain = plain_pieces();
  Vector phi(x.size(), 0.0);
  poisson_.residual = [&](const Vector& now, Vector& r) {
    r.resize(now.size());
    poisson_.apply(now, r);
    for (std::size_t q = 0; q < r.size(); ++q) r[q] = -sigma_ * divergence[q] - r[q];
  };
  amr::GmresOptions of_phi = o;
  of_phi.tolerance *= 0.25;  // the divergence that is left is rougher than phi
  const amr::GmresResult p = poisson_.solve(phi, plain, of_phi, [&](const Vector& now) { return plain.norm(now); });
  result.iterations += m.iterations + p.iterations;
  result.converged = result.converged && m.converged && p.converged;

  unpack(phi, work_);
  unpack(divergence, image_);
  for_leaves([&](int, int g, int i, double) {
    amr::copy_box(pressure_.ref(g, i, 0), {}, std::as_const(work_).ref(g, i, PRESSURE), {}, filled(mesh_.layout().n));
  });
  hierarchy_.make_composite(pressure_, 1, true);
  unpack(x, state_);
  subtract_gradient(pressure_, 1 / sigma_, state_);
  for_leaves([&](int, int g, int i, double) {
    const Layout& layout = hierarchy_.grid(g).layout;
    const double *nu = viscosity_.at(g, i, 0), *d = image_.at(g, i, PRESSURE), *change = pressure_.at(g, i, 0);
    double* to = state_.at(g, i, PRESSURE);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
      const std::ptrdiff_t c = layout.offset(q);
      to[c] += change[c] - (options_.rotational ? nu[c] * d[c] : 0.0);
    });
  });
  pack(state_, x);
}

}  // namespace dendrift::physics

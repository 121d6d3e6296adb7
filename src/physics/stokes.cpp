#include "physics/stokes.hpp"

#include <algorithm>
#include <cmath>

namespace dendrift::physics {

using amr::Component;
using amr::Grid;
using amr::HierarchyField;
using amr::Layout;
using amr::Range;

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

// Least sigma + kappa in the pressure's preconditioner, over the largest kappa: so that steady flow has one as well.
constexpr double FAINT = 1e-6;

// Residual that is round-off, over the norm of velocity and pressure. Melt that stands still under its own weight has a
// pressure and no velocity that a residual could be compared with.
constexpr double ROUND_OFF = 1e-13;

// On some meshes the preconditioned residual shows a hundredth of an error in the spin of a large crystal, solution after solution,
// and extrapolated first guesses let it grow. The torque that is left shows it: RigidModes asks for a fifth or so of what is missing,
// because melt within two radii turns with the crystal there. Above SPINS tolerances of the largest speed the iteration goes on.
constexpr double SPINS = 4, TIGHTER = 0.2, TIGHTEST = 1e-3;

constexpr int EDGES = DIM == 2 ? 1 : 3;  // pairs of axes

// Component of viscosity_ that holds the edges along which neither a nor b changes; 0 is the cells.
constexpr int edge_component(int a, int b) { return DIM == 2 ? 1 : a + b; }

// v and p at the sides of the box.
std::vector<Component> stokes_components(const amr::MeshShape& shape) {
  std::vector<Component> list(DIM + 1);
  for (int c = 0; c <= DIM; ++c) {
    list[at(c)].normal = c < DIM ? c : -1;
    for (int f = 0; f < FACES; ++f) {
      bool& odd = list[at(c)].sides[at(f)].odd;
      switch (shape.sides[at(f)]) {
        case amr::Side::wall: odd = c < DIM; break;
        case amr::Side::symmetry: odd = c == face_axis(f); break;
        case amr::Side::open: odd = c == DIM; break;
        case amr::Side::periodic: break;
      }
    }
  }
  return list;
}

std::vector<Component> velocities(const std::vector<Component>& all) { return {all.begin(), all.begin() + DIM}; }

}  // namespace

StokesSolver::StokesSolver(const amr::Mesh& mesh, const StokesOptions& options)
    : options_(options), mesh_(mesh), hierarchy_(mesh), components_(stokes_components(mesh.shape())),
      state_(hierarchy_, components_), force_(hierarchy_, components_), work_(hierarchy_, components_),
      image_(hierarchy_, components_), viscosity_(hierarchy_, std::vector<Component>(1 + EDGES)),
      pressure_(hierarchy_, {components_[DIM]}) {
  for (const amr::Side s : mesh.shape().sides) closed_ = closed_ && s != amr::Side::open;
  velocity_cycle_ = std::make_unique<amr::Multigrid>(hierarchy_, velocities(components_), viscosity_,
                                                     amr::MultigridOptions{.lowest = 12, .bottom = options.bottom});
  pressure_cycle_ = std::make_unique<amr::Multigrid>(hierarchy_, std::vector<Component>{components_[DIM]}, viscosity_,
                                                     amr::MultigridOptions{.bottom = options.bottom});
  pressure_cycle_->prepare({amr::Links{}});
  gmres_.residual = [this](const Vector& x, Vector& r) {
    unpack(x, state_);
    hierarchy_.make_composite(state_, 1, false);
    apply(state_, &force_, image_);
    pack(image_, r);
  };
  gmres_.apply = [this](const Vector& v, Vector& w) {
    unpack(v, work_);
    hierarchy_.make_composite(work_, 1, true);
    apply(work_, nullptr, image_);
    pack(image_, w);
  };
  momentum_of_motion_ = [this, no_pressure = std::vector<double>(at(static_cast<int>(mesh.layout().size())))](
                            int b, const Array<const double*>& v, const Array<double*>& out) {
    momentum(b, v, no_pressure.data() + mesh_.layout().interior(), out);
  };
  gmres_.precondition = [this](Vector& r) {
    unpack(r, image_);
    precondition(image_);
    pack(image_, r);
  };
}

std::vector<amr::Links> StokesSolver::velocity_links(double sigma) const {
  std::vector<amr::Links> links(DIM);
  for (int a = 0; a < DIM; ++a) {
    links[at(a)].sigma = sigma;
    links[at(a)].coupled = options_.stress == Stress::symmetric;
    for (int b = 0; b < DIM; ++b) {
      amr::Links::Along& along = links[at(a)].along[b];
      along.field = a == b ? 0 : edge_component(a, b);
      along.below = a == b ? 1 : 0;
      along.factor = a == b && options_.stress == Stress::symmetric ? 2 : 1;
    }
  }
  return links;
}

template <class F>
void StokesSolver::with_phase(int b, const std::function<void(int, double*)>& phase, F&& f) const {
  thread_local std::vector<double> phi_array;
  phi_array.resize(static_cast<std::size_t>(mesh_.layout().size()));
  double* phi = phi_array.data() + mesh_.layout().interior();
  phase(b, phi);
  f(phi);
}

void StokesSolver::set_viscosity(const std::function<void(int, double*)>& phase, const std::function<double(double)>& law) {
  // Edges take nu of the mean phi: an arithmetic mean of nu would make thin gaps stiff.
  const auto fill_leaf = [&](int b, int g, int i) {
    with_phase(b, phase, [&](const double* phi) {
      const Layout& layout = mesh_.layout();
      double* nu = viscosity_.at(g, i, 0);
      amr::for_each_cell(filled(-Layout::GHOSTS), filled(layout.pitch()), [&](const IntVec& c) {
        nu[layout.offset(c)] = law(phi[layout.offset(c)]);
      });
      for (int a = 0; a < DIM; ++a)
        for (int e = a + 1; e < DIM; ++e) {
          double* edge = viscosity_.at(g, i, edge_component(a, e));
          const std::ptrdiff_t s = layout.stride(a), t = layout.stride(e);
          amr::for_each_cell(filled(1 - Layout::GHOSTS), filled(layout.pitch() - 1), [&](const IntVec& c) {
            const double* p = phi + layout.offset(c);
            edge[layout.offset(c)] = law(0.25 * ((p[0] + p[-s]) + (p[-t] + p[-s - t])));
          });
        }
    });
  };
  for_leaves([&](int b, int g, int i, double) { fill_leaf(b, g, i); });
  std::array<IntVec, 1 + EDGES> below{};  // where the finer cells round an edge begin
  for (int a = 0; a < DIM; ++a)
    for (int e = a + 1; e < DIM; ++e) below[at(edge_component(a, e))][a] = below[at(edge_component(a, e))][e] = 1;
  for (int g = 0; g + 1 < hierarchy_.grids(); ++g) {
    const Grid& coarse = hierarchy_.grid(g + 1);
    // The square of the mean of square roots: of the children, and of the finer cells round an edge. Means of the coarse cells
    // round an edge reach as far again and make solids thicker on every grid (velocities alone, a disc of 512^2, at 1e4 and 1e6:
    // 14, 17 iterations for 11, 13). Arithmetic and geometric means of cells were no better.
    hierarchy_.restrict_roots(viscosity_, g, below);
    hierarchy_.exchange(viscosity_, g + 1, Layout::GHOSTS);
    amr::parallel_for(coarse.size(), [&](int i) {
      const Grid::Node& n = coarse.mine(i);
      if (n.leaf >= 0) {  // an edge that it shares with finer nodes is its own
        fill_leaf(mesh_.local(n.leaf), g + 1, i);
      } else {
        extend_viscosity(g + 1, i);
      }
    });
  }
  set_up_pieces();
}

// A parent's cells where a coarser leaf lies, as the nearest, and its edges there and beyond the sides, from its cells: finer
// ones do not surround them.
void StokesSolver::extend_viscosity(int g, int i) {
  const Grid::Node& n = hierarchy_.grid(g).mine(i);
  if (std::ranges::all_of(n.neighbours, [](int m) { return m >= 0; })) return;
  const Layout& layout = hierarchy_.grid(g).layout;
  double* nu = viscosity_.at(g, i, 0);
  for (int d = 0; d < DIRECTIONS; ++d) {
    if (n.neighbours[at(d)] != Grid::COARSER) continue;
    const IntVec o = direction_offset(d);
    IntVec lo{}, size{};
    for (int a = 0; a < DIM; ++a) {
      lo[a] = o[a] < 0 ? -Layout::GHOSTS : o[a] > 0 ? layout.n : 0;
      size[a] = o[a] == 0 ? layout.n : Layout::GHOSTS;
    }
    amr::for_each_cell(lo, size, [&](const IntVec& c) {
      IntVec near = c;
      for (int& k : near) k = std::clamp(k, 0, layout.n - 1);
      nu[layout.offset(c)] = nu[layout.offset(near)];
    });
  }
  // Whether all cells round an edge of the plane (a, e) lie in nodes of this grid.
  const auto among_nodes = [&](const IntVec& c, int a, int e) {
    const auto step = [&](int k) { return k < 0 ? -1 : k >= layout.n ? 1 : 0; };
    for (int corner = 0; corner < 4; ++corner) {
      IntVec o = c;
      o[a] -= corner & 1;
      o[e] -= corner >> 1;
      for (int& k : o) k = step(k);
      if (o != IntVec{} && n.neighbours[at(direction_index(o))] < 0) return false;
    }
    return true;
  };
  for (int a = 0; a < DIM; ++a)
    for (int e = a + 1; e < DIM; ++e) {
      double* edge = viscosity_.at(g, i, edge_component(a, e));
      const std::ptrdiff_t s = layout.stride(a), t = layout.stride(e);
      amr::for_each_cell(filled(1 - Layout::GHOSTS), filled(layout.pitch() - 1), [&](const IntVec& c) {
        if (among_nodes(c, a, e)) return;
        const double* p = nu + layout.offset(c);
        const double mean = 0.25 * ((std::sqrt(p[0]) + std::sqrt(p[-s])) + (std::sqrt(p[-t]) + std::sqrt(p[-s - t])));
        edge[layout.offset(c)] = mean * mean;
      });
    }
}

void StokesSolver::set_drag(const std::function<void(int, double*)>& phase, const std::function<double(double)>& law,
                            const std::vector<RealVec>& centres, const RigidBodies::Owners& owners) {
  std::vector<Component> faces(DIM);
  for (int a = 0; a < DIM; ++a) faces[at(a)].normal = a;
  if (drag_ == nullptr) {
    drag_ = std::make_unique<HierarchyField>(hierarchy_, faces);
    mobility_ = std::make_unique<HierarchyField>(hierarchy_, faces);
    pressure_cycle_ = std::make_unique<amr::Multigrid>(hierarchy_, std::vector<Component>{components_[DIM]}, *mobility_,
                                                       amr::MultigridOptions{.bottom = options_.bottom});
  }
  for_leaves([&](int b, int g, int i, double) {
    with_phase(b, phase, [&](const double* phi) {
      const Layout& layout = mesh_.layout();
      for (int a = 0; a < DIM; ++a) {
        double* kappa = drag_->at(g, i, a);
        amr::for_each_cell(filled(1 - Layout::GHOSTS), filled(layout.pitch() - 1), [&](const IntVec& c) {
          const double* p = phi + layout.offset(c);
          kappa[layout.offset(c)] = law(0.5 * (p[0] + p[-layout.stride(a)]));
        });
      }
    });
  });
  double largest = 0;
  for (int b = 0; b < mesh_.size(); ++b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    for (int a = 0; a < DIM; ++a) {
      const double* kappa = drag_->at(g, i, a);
      amr::for_each_cell({}, filled(mesh_.layout().n), [&](const IntVec& q) { largest = std::max(largest, kappa[mesh_.layout().offset(q)]); });
    }
  }
  largest_drag_ = std::max(amr::global_max(largest, mesh_.comm()), 1e-300);
  for (int g = 0; g + 1 < hierarchy_.grids(); ++g) hierarchy_.restrict_means(*drag_, *drag_, g);
  for (int g = 0; g < hierarchy_.grids(); ++g) hierarchy_.exchange(*drag_, g, Layout::GHOSTS);
  bodies_.build(hierarchy_, *drag_, centres, owners);
}

// -div[1/(sigma + kappa) grad], which the solid's drag stops.
void StokesSolver::prepare_pressure() {
  for (int g = 0; g < hierarchy_.grids(); ++g)
    amr::parallel_for(hierarchy_.grid(g).size(), [&](int i) {
      const Layout& layout = hierarchy_.grid(g).layout;
      const std::ptrdiff_t origin = layout.interior();
      for (int a = 0; a < DIM; ++a) {
        const double* kappa = drag_->at(g, i, a) - origin;
        double* m = mobility_->at(g, i, a) - origin;
        for (std::ptrdiff_t q = 0; q < layout.size(); ++q) m[q] = 1 / std::max(sigma_ + kappa[q], FAINT * largest_drag_);
      }
    });
  amr::Links links;
  for (int a = 0; a < DIM; ++a) links.along[a].field = a;
  pressure_cycle_->prepare({links});
}

void StokesSolver::set_up_pieces() {
  pieces_.first.assign(1, 0);
  pieces_.weight.clear();
  pieces_.comm = mesh_.comm();
  const double finest = hierarchy_.grid(0).dx;
  for (int b = 0; b < mesh_.size(); ++b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    const Layout& layout = hierarchy_.grid(g).layout;
    const double dx = hierarchy_.grid(g).dx, cell = std::pow(dx / finest, DIM);
    for (int c = 0; c <= DIM; ++c) {
      const Range r = hierarchy_.unknowns(g, i, components_[at(c)], true);
      const double* nu = viscosity_.at(g, i, 0);
      amr::for_each_cell(r.lo, r.size, [&](const IntVec& q) {
        const double p = dx / (2 * nu[layout.offset(q)]);  // a pressure as the velocity that it stands for
        pieces_.weight.push_back(c < DIM ? cell : cell * p * p);
      });
    }
    pieces_.first.push_back(static_cast<std::ptrdiff_t>(pieces_.weight.size()));
  }
}

void StokesSolver::pack(const HierarchyField& f, Vector& v) const {
  v.resize(pieces_.size());
  for_leaves([&](int b, int g, int i, double) {
    double* p = v.data() + pieces_.first[at(b)];
    const Layout& layout = hierarchy_.grid(g).layout;
    for (int c = 0; c <= DIM; ++c) {
      const Range r = hierarchy_.unknowns(g, i, components_[at(c)], true);
      const double* x = f.at(g, i, c) + layout.offset(r.lo);
      amr::for_each_row(r.size, [&](const IntVec& row) {
        p = std::copy_n(x + layout.offset(row), r.size[0], p);
      });
    }
  });
}

void StokesSolver::unpack(const Vector& v, HierarchyField& f) const {
  for_leaves([&](int b, int g, int i, double) {
    const double* p = v.data() + pieces_.first[at(b)];
    const Layout& layout = hierarchy_.grid(g).layout;
    for (int c = 0; c <= DIM; ++c) {
      const Range r = hierarchy_.unknowns(g, i, components_[at(c)], true);
      double* x = f.at(g, i, c) + layout.offset(r.lo);
      amr::for_each_row(r.size, [&](const IntVec& row) {
        std::copy_n(p, r.size[0], x + layout.offset(row));
        p += r.size[0];
      });
    }
  });
}

// sigma v - div[nu (grad v + grad v^T)] + grad p and what the solid's drag adds, on the unknown faces of local block b.
void StokesSolver::momentum(int b, const Array<const double*>& velocity, const double* p, const Array<double*>& result) const {
  const bool symmetric = options_.stress == Stress::symmetric;
  const auto [g, i] = hierarchy_.place_of_block(b);
  const Layout& layout = hierarchy_.grid(g).layout;
  const double h = 1 / hierarchy_.grid(g).dx, h2 = h * h;
  const double* nu = viscosity_.at(g, i, 0);
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = layout.stride(a);
    const double* v = velocity[a];
    double* out = result[a];
    const double twice = symmetric ? 2 * h2 : h2;
    const Range r = hierarchy_.unknowns(g, i, components_[at(a)], true);
    const std::ptrdiff_t start = layout.offset(r.lo);
    const double* kappa = drag_ != nullptr ? drag_->at(g, i, a) : nullptr;
    Array<const double*> edges{};
    for (int e = 0; e < DIM; ++e) edges[e] = e == a ? nullptr : viscosity_.at(g, i, edge_component(a, e));
    amr::for_each_row(r.size, [&](const IntVec& row) {
      const std::ptrdiff_t q0 = start + layout.offset(row);
#pragma omp simd
      for (std::ptrdiff_t q = q0; q < q0 + r.size[0]; ++q)
        out[q] = sigma_ * v[q] - twice * (nu[q] * (v[q + s] - v[q]) - nu[q - s] * (v[q] - v[q - s])) + h * (p[q] - p[q - s]);
      for (int e = 0; e < DIM; ++e) {
        if (e == a) continue;
        const std::ptrdiff_t t = layout.stride(e);
        const double* edge = edges[e];
        if (symmetric) {
          const double* u = velocity[e];
#pragma omp simd
          for (std::ptrdiff_t q = q0; q < q0 + r.size[0]; ++q)
            out[q] -= h2 * (edge[q + t] * ((v[q + t] - v[q]) + (u[q + t] - u[q + t - s])) -
                            edge[q] * ((v[q] - v[q - t]) + (u[q] - u[q - s])));
        } else {
#pragma omp simd
          for (std::ptrdiff_t q = q0; q < q0 + r.size[0]; ++q)
            out[q] -= h2 * (edge[q + t] * (v[q + t] - v[q]) - edge[q] * (v[q] - v[q - t]));
        }
      }
      if (kappa == nullptr) return;
#pragma omp simd
      for (std::ptrdiff_t q = q0; q < q0 + r.size[0]; ++q) out[q] += kappa[q] * v[q];
    });
  }
}

// y = K x, or rhs - K x, on the leaves' unknowns. Ghosts of x are filled.
void StokesSolver::apply(const HierarchyField& x, const HierarchyField* rhs, HierarchyField& y) {
  if (!bodies_.empty()) bodies_.fit(x);
  for_leaves([&](int b, int g, int i, double dx) {
    const Layout& layout = hierarchy_.grid(g).layout;
    const double h = 1 / dx;
    Array<const double*> velocity;
    Array<double*> result;
    for (int a = 0; a < DIM; ++a) {
      velocity[a] = x.at(g, i, a);
      result[a] = y.at(g, i, a);
    }
    momentum(b, velocity, x.at(g, i, PRESSURE), result);
    if (!bodies_.empty()) bodies_.subtract(b, y);
    double* div = y.at(g, i, PRESSURE);
    amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
      const std::ptrdiff_t q0 = layout.offset(row);
      for (std::ptrdiff_t q = q0; q < q0 + layout.n; ++q) {
        double sum = 0;
        for (int a = 0; a < DIM; ++a) {
          const double* v = x.at(g, i, a) + q;
          sum += v[layout.stride(a)] - v[0];
        }
        div[q] = h * sum;
      }
    });
    if (rhs == nullptr) return;
    for (int c = 0; c <= DIM; ++c) {
      const Range r = hierarchy_.unknowns(g, i, components_[at(c)], true);
      const double* f = rhs->at(g, i, c);
      double* out = y.at(g, i, c);
      amr::for_each_cell(r.lo, r.size, [&](const IntVec& q) {
        const std::ptrdiff_t o = layout.offset(q);
        out[o] = f[o] - out[o];
      });
    }
  });
}

void StokesSolver::remove_mean_pressure(HierarchyField& f) const {
  if (!closed_) return;
  std::vector<double> sums(at(mesh_.size()));
  double volume_of_box = 1;
  const RealVec hi = mesh_.shape().hi();
  for (int a = 0; a < DIM; ++a) volume_of_box *= hi[a] - mesh_.shape().lo[a];
  for_leaves([&](int b, int g, int i, double dx) {
    const Layout& layout = hierarchy_.grid(g).layout;
    double sum = 0;
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) { sum += f.at(g, i, PRESSURE)[layout.offset(q)]; });
    sums[at(b)] = sum * std::pow(dx, DIM);
  });
  std::vector<amr::ExactSum> total(1);
  for (const double s : sums) total[0].add(s);
  const double mean = amr::exact_sums(total, mesh_.comm())[0] / volume_of_box;
  for_leaves([&](int, int g, int i, double) {
    const Layout& layout = hierarchy_.grid(g).layout;
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) { f.at(g, i, PRESSURE)[layout.offset(q)] -= mean; });
  });
}

// pressure_cycle_'s solution for the pressures of r.
void StokesSolver::cycle_pressure(HierarchyField& r) {
  remove_mean_pressure(r);
  for_leaves([&](int, int g, int i, double) {
    amr::copy_box(pressure_cycle_->rhs().ref(g, i, 0), {}, std::as_const(r).ref(g, i, PRESSURE), {}, filled(mesh_.layout().n));
  });
  pressure_cycle_->cycle();
}

// Velocities of r = one cycle for r - grad of pressure_, whose ghosts are filled.
void StokesSolver::cycle_velocity(HierarchyField& r) {
  const IntVec whole = filled(mesh_.layout().n + 1);
  for_leaves([&](int, int g, int i, double dx) {
    const Layout& layout = hierarchy_.grid(g).layout;
    const double* p = pressure_.at(g, i, 0);
    for (int a = 0; a < DIM; ++a) {
      const Range u = hierarchy_.unknowns(g, i, components_[at(a)], true);
      double* to = velocity_cycle_->rhs().at(g, i, a);
      const double* from = r.at(g, i, a);
      amr::for_each_cell({}, whole, [&](const IntVec& q) { to[layout.offset(q)] = 0; });
      const std::ptrdiff_t s = layout.stride(a);
      amr::for_each_cell(u.lo, u.size, [&](const IntVec& q) {
        const std::ptrdiff_t o = layout.offset(q);
        to[o] = from[o] - (p[o] - p[o - s]) / dx;
      });
    }
  });
  velocity_cycle_->cycle();
  for_leaves([&](int, int g, int i, double) {
    for (int a = 0; a < DIM; ++a)
      amr::copy_box(r.ref(g, i, a), {}, std::as_const(velocity_cycle_->solution()).ref(g, i, a), {}, whole);
  });
}

// In place: rigid motions of crystals, then pressure from the divergence, then velocities from what both leave of the momentum.
void StokesSolver::precondition(HierarchyField& r) {
  const bool cycle = sigma_ > 0 || drag_ != nullptr;
  const double factor = drag_ != nullptr ? 1.0 : sigma_;  // of -div grad, or it is in the mobility
  if (!rigid_.empty()) rigid_.take_from(r, momentum_of_motion_);
  if (cycle) cycle_pressure(r);
  for_leaves([&](int, int g, int i, double) {
    const Layout& layout = hierarchy_.grid(g).layout;
    const double *nu = viscosity_.at(g, i, 0), *lap = pressure_cycle_->solution().at(g, i, 0), *d = r.at(g, i, PRESSURE);
    double* p = pressure_.at(g, i, 0);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
      const std::ptrdiff_t o = layout.offset(q);
      p[o] = nu[o] * d[o] + (cycle ? factor * lap[o] : 0.0);
    });
  });
  hierarchy_.make_composite(pressure_, 1, true);
  cycle_velocity(r);
  if (!rigid_.empty()) rigid_.add_to(r);
  for_leaves([&](int, int g, int i, double) {
    amr::copy_box(r.ref(g, i, PRESSURE), {}, std::as_const(pressure_).ref(g, i, 0), {}, filled(mesh_.layout().n));
  });
  remove_mean_pressure(r);
}

// The norm of the velocity alone: what the error of the solution is measured against.
double StokesSolver::speed(const Vector& x) const {
  const std::ptrdiff_t cells = volume(filled(mesh_.layout().n));
  std::vector<double> squares(at(mesh_.size()));
  amr::parallel_for(mesh_.size(), [&](int b) {
    const double *w = pieces_.weight.data(), *v = x.data();
    double sum = 0;
    for (std::ptrdiff_t q = pieces_.first[at(b)]; q < pieces_.first[at(b) + 1] - cells; ++q)
      sum += w[q] * v[q] * v[q];
    squares[at(b)] = sum;
  });
  std::vector<amr::ExactSum> total(1);
  for (const double s : squares) total[0].add(s);
  return std::sqrt(amr::exact_sums(total, mesh_.comm())[0]);
}

// What the tolerance refers to: the velocity, unless it is lost in the round-off of the pressure.
double StokesSolver::size(const Vector& x) const {
  return std::max(speed(x), ROUND_OFF / options_.tolerance * pieces_.norm(x));
}

// Sets the pressures, or the velocities, to 0.
void StokesSolver::blank(Vector& v, bool pressures) const {
  const std::ptrdiff_t cells = volume(filled(mesh_.layout().n));
  for (int b = 0; b < mesh_.size(); ++b) {
    double *first = v.data() + pieces_.first[at(b)], *last = v.data() + pieces_.first[at(b) + 1];
    std::fill(pressures ? last - cells : first, pressures ? last : last - cells, 0.0);
  }
}

StokesResult StokesSolver::solve(double sigma) {
  sigma_ = sigma;
  velocity_cycle_->prepare(velocity_links(sigma), drag_.get());
  if (drag_ != nullptr) prepare_pressure();
  Vector x;
  pack(state_, x);
  if (options_.coupling == Coupling::projection) {
    StokesResult result = project(x);
    finish(x, result);
    return result;
  }
  rigid_.prepare(momentum_of_motion_);
  amr::GmresOptions o;
  o.tolerance = options_.tolerance;
  StokesResult result;
  do {
    o.max_iterations = options_.max_iterations - result.iterations;
    const amr::GmresResult g = gmres_.solve(x, pieces_, o, [this](const Vector& now) { return size(now); });
    result.iterations += g.iterations;
    result.converged = result.converged || g.converged;  // the first time, to the tolerance that was asked for
    result.error = g.residual;
    finish(x, result);
    if (!g.converged) break;
    o.tolerance *= TIGHTER;
  } while (o.tolerance > TIGHTEST * options_.tolerance &&
           rigid_.fastest_spin(image_) > SPINS * options_.tolerance * result.fastest);
  return result;
}

// Products with pressures weighted by volume like velocities, not as the velocities that they stand for.
amr::Pieces StokesSolver::plain_pieces() const {
  amr::Pieces plain = pieces_;
  for (int b = 0; b < mesh_.size(); ++b) {
    const std::ptrdiff_t cells = volume(filled(mesh_.layout().n));
    const double cell = std::pow(mesh_.block(b).dx / hierarchy_.grid(0).dx, DIM);
    std::fill_n(plain.weight.begin() + (pieces_.first[at(b) + 1] - cells), cells, cell);
  }
  return plain;
}

void StokesSolver::finish(const Vector& x, StokesResult& result) {
  unpack(x, state_);
  fill_state();
  apply(state_, &force_, image_);
  const double scale = speed(x);
  if (scale > 0) result.error /= scale;
  double div = 0, fastest = 0;
  for (int b = 0; b < mesh_.size(); ++b) {
    const auto [g, i] = hierarchy_.place_of_block(b);
    const Layout& layout = hierarchy_.grid(g).layout;
    Array<const double*> velocity;
    for (int a = 0; a < DIM; ++a) velocity[a] = state_.at(g, i, a);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
      double sum = 0;
      for (int a = 0; a < DIM; ++a) {
        const double* v = velocity[a] + layout.offset(q);
        sum += v[layout.stride(a)] - v[0];
        fastest = std::max({fastest, std::abs(v[0]), std::abs(v[layout.stride(a)])});
      }
      div = std::max(div, std::abs(sum));
    });
  }
  div = amr::global_max(div, mesh_.comm());
  result.fastest = amr::global_max(fastest, mesh_.comm());
  result.divergence_max = result.fastest > 0 ? div / result.fastest : div;
}

}  // namespace dendrift::physics

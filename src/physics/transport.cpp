#include "physics/transport.hpp"

#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/transfer.hpp"

namespace dendrift::physics {

namespace {

// Cubic Lagrange weights for the points -1, 0, 1, 2 at position t in [0, 1].
std::array<double, 4> cubic_weights(double t) {
  return {-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2,
          (t + 1) * t * (t - 1) / 6};
}

double solute_per_phase(double psi, double k) {
  // A(phi) = [1+k-(1-k)phi]/2 = (1 + k e^2)/(1 + e^2), e = exp(psi/sqrt 2)
  const double e = fast_exp(psi / SQRT2);
  return (1 + k * e * e) / (1 + e * e);
}

}  // namespace

void Transport::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  fluxes_ = std::make_unique<amr::FluxRegister>(mesh);
  const amr::FieldTable& f = mesh.fields();
  psi_.id = f.find("psi").value();
  c_.id = f.find("c").value();
  psi_other_.id = f.find("psi_other").value();
  c_other_.id = f.find("c_other").value();
  v_.id = f.find("velocity_x").value();
}

void Transport::after_regrid() {
  const amr::Layout& layout = mesh_->layout();
  double fastest = 0, rate = 0;
  for (int b = 0; b < mesh_->size(); ++b) {
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& c) {
      double square = 0, sum = 0;
      for (int a = 0; a < DIM; ++a) {
        const double v = std::abs(mesh_->faces(v_, a, b)[layout.offset(c)]);
        square += v * v;
        sum += v / mesh_->block(b).dx;
      }
      fastest = std::max(fastest, std::sqrt(square));
      rate = std::max(rate, sum);
    });
  }
  fastest_ = amr::global_max(fastest, mesh_->comm());
  largest_rate_ = amr::global_max(rate, mesh_->comm());
}

double Transport::max_dt() const { return largest_rate_ > 0 ? 0.5 / largest_rate_ : 1e30; }

// psi(x, t + dt) = psi(X, t), X found by the midpoint rule; less than a cell away, so two ghost layers do.
void Transport::carry_phase(int b, double dt) const {
  const amr::Layout& layout = mesh_->layout();
  const double* psi = mesh_->cells(psi_, b);
  double* next = mesh_->cells(psi_other_, b);
  const double back = dt / mesh_->block(b).dx;
  std::array<const double*, DIM> v{};
  for (int a = 0; a < DIM; ++a) v[static_cast<std::size_t>(a)] = mesh_->faces(v_, a, b);
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
    const std::ptrdiff_t q = layout.offset(cell);
    RealVec u{}, shift{};
    for (int a = 0; a < DIM; ++a) {
      const double* f = v[static_cast<std::size_t>(a)] + q;
      u[a] = 0.5 * (f[0] + f[layout.stride(a)]);
    }
    for (int a = 0; a < DIM; ++a) {  // velocity half a step upstream, to first order
      const double* f = v[static_cast<std::size_t>(a)] + q;
      double at_middle = u[a];
      for (int d = 0; d < DIM; ++d) {
        const std::ptrdiff_t s = layout.stride(d), r = layout.stride(a);
        const double slope = d == a ? f[r] - f[0] : 0.25 * ((f[s] - f[-s]) + (f[s + r] - f[-s + r]));
        at_middle -= 0.5 * back * u[d] * slope;
      }
      shift[a] = -back * at_middle;
    }
    std::ptrdiff_t base = q;
    std::array<std::array<double, 4>, DIM> w{};
    for (int a = 0; a < DIM; ++a) {
      const double cellwise = std::floor(shift[a]);
      base += static_cast<std::ptrdiff_t>(cellwise) * layout.stride(a);
      w[static_cast<std::size_t>(a)] = cubic_weights(shift[a] - cellwise);
    }
    double value = 0;
    for (int k = 0; k < (DIM == 3 ? 4 : 1); ++k) {
      double plane = 0;
      for (int j = 0; j < 4; ++j) {
        const double* p = psi + base + (j - 1) * layout.stride(1) + (DIM == 3 ? (k - 1) * layout.stride(DIM - 1) : 0);
        double row = 0;
        for (int i = 0; i < 4; ++i) row += w[0][static_cast<std::size_t>(i)] * p[i - 1];
        plane += w[1][static_cast<std::size_t>(j)] * row;
      }
      value += (DIM == 3 ? w[DIM - 1][static_cast<std::size_t>(k)] : 1.0) * plane;
    }
    next[q] = std::clamp(value, -PSI_MAX, PSI_MAX);
  });
}

void Transport::carry_solute(int b, double dt) {
  const amr::Layout& layout = mesh_->layout();
  const int n = layout.n;
  const double dx = mesh_->block(b).dx;
  const double* psi = mesh_->cells(psi_, b);
  const double* c = mesh_->cells(c_, b);
  double* next = mesh_->cells(c_other_, b);
  thread_local std::vector<double> u_array, flux_array;
  const auto size = static_cast<std::size_t>(layout.size());
  u_array.resize(size);
  flux_array.resize(size);
  double* u = u_array.data() + layout.interior();
  double* flux = flux_array.data() + layout.interior();
  for (std::ptrdiff_t q = -layout.interior(); q < layout.size() - layout.interior(); ++q)
    u[q] = c[q] / solute_per_phase(psi[q], k_);  // 1 + (1-k) U
  amr::for_each_row(filled(n), [&](const IntVec& row) {
    const std::ptrdiff_t o = layout.offset(row);
    std::copy_n(c + o, n, next + o);
  });
  for (int axis = 0; axis < DIM; ++axis) {
    const std::ptrdiff_t s = layout.stride(axis);
    const double* v = mesh_->faces(v_, axis, b);
    // psi at a face in the middle of the step, to first order in time along the flow.
    auto psi_face = [&](std::ptrdiff_t q, double middle) {  // face between q - s and q
      double p = middle - 0.5 * dt / dx * v[q] * (psi[q] - psi[q - s]);
      for (int d = 0; d < DIM; ++d) {
        if (d == axis) continue;
        const std::ptrdiff_t r = layout.stride(d);
        const double* f = mesh_->faces(v_, d, b);
        const double across = 0.25 * ((f[q] + f[q + r]) + (f[q - s] + f[q - s + r]));
        p -= 0.125 * dt / dx * across * ((psi[q + r] - psi[q - r]) + (psi[q - s + r] - psi[q - s - r]));
      }
      return solute_per_phase(p, k_);
    };
    IntVec extent = filled(n);
    ++extent[axis];
    amr::for_each_cell({}, extent, [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      const double second = 0.5 * (psi[q] + psi[q - s]);
      const double fourth = 0.5625 * (psi[q] + psi[q - s]) - 0.0625 * (psi[q + s] + psi[q - 2 * s]);
      // Outer faces see no third neighbour; in the correction the mean of two is accurate enough.
      const double before = solute_per_phase(0.5 * (psi[q - s] + psi[q - 2 * s]) -
                                                 0.5 * dt / dx * v[q - s] * (psi[q - s] - psi[q - 2 * s]), k_);
      const double after =
          solute_per_phase(0.5 * (psi[q + s] + psi[q]) - 0.5 * dt / dx * v[q + s] * (psi[q + s] - psi[q]), k_);
      const double centre = solute_per_phase(second - 0.5 * dt / dx * v[q] * (psi[q] - psi[q - s]), k_);
      const double a = psi_face(q, fourth) - (after - 2 * centre + before) / 24;
      // U at the face: third order upwind, centred in time, held between the two cells that share the face.
      const double courant = v[q] * dt / dx;
      const double du = u[q] - u[q - s];
      const double curvature = v[q] > 0 ? u[q] - 2 * u[q - s] + u[q - 2 * s] : u[q + s] - 2 * u[q] + u[q - s];
      double uf = 0.5 * (u[q] + u[q - s]) - 0.5 * courant * du - (1 - courant * courant) / 6 * curvature;
      uf = std::clamp(uf, std::min(u[q], u[q - s]), std::max(u[q], u[q - s]));
      flux[q] = v[q] * a * uf;
    });
    amr::for_each_cell({}, filled(n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      next[q] -= dt / dx * (flux[q + s] - flux[q]);
    });
    for (const int face : {2 * axis, 2 * axis + 1}) {
      double* out = fluxes_->store(b, face);
      if (out == nullptr) continue;
      IntVec lo{}, extent_face = filled(n);
      lo[axis] = face_is_high(face) ? n : 0;
      extent_face[axis] = 1;
      amr::for_each_cell(lo, extent_face, [&](const IntVec& cell) { *out++ = flux[layout.offset(cell)]; });
    }
  }
}

void Transport::advance(double, double dt, std::int64_t) {
  fluxes_->prepare();
  ghosts_->fill_and_run({psi_, c_}, [&](int b) {
    carry_phase(b, dt);
    carry_solute(b, dt);
  });
  fluxes_->correct(c_other_, -dt);
  mesh_->swap(psi_, psi_other_);
  mesh_->swap(c_, c_other_);
}

}  // namespace dendrift::physics

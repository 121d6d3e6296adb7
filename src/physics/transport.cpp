#include "physics/transport.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"

namespace dendrift::physics {

namespace {

constexpr double COURANT = 0.6;  // largest sum of Courant numbers over the axes; the scheme is stable to about 1.2

// Intermediate results of a block, indexed like its arrays.
struct Scratch {
  std::vector<double> e, u, ratio, flux;  // exp(psi/sqrt 2); 1+(1-k)U; A at low faces; flux through them
  void resize(std::ptrdiff_t size) {
    for (std::vector<double>* v : {&e, &u, &ratio, &flux}) v->resize(static_cast<std::size_t>(size));
  }
};

Scratch& scratch() {
  thread_local Scratch s;
  return s;
}

// The value that the upwind cell hands to the face, third order where smooth, limited so that it lies between the
// cells on both sides (Koren, 1993). `behind` and `ahead` are the differences on both sides of the upwind cell.
inline double limited(double upwind, double behind, double ahead) {
  const double s = behind < 0 ? -1.0 : 1.0;
  const double slope = std::min(std::min(2.0 * s * ahead, s * (behind + 2.0 * ahead) / 3.0), 2.0 * s * behind);
  return upwind + 0.5 * s * std::max(0.0, slope);
}

}  // namespace

void Transport::declare(amr::FieldTable& fields) {
  amr::FieldSpec scratch_field;
  scratch_field.doc = "phase and solute within a step of transport; scratch";
  scratch_field.name = "psi_carried";
  second_.psi = fields.add_cell(scratch_field);
  scratch_field.name = "c_carried";
  second_.c = fields.add_cell(scratch_field);
}

void Transport::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  fluxes_ = std::make_unique<amr::FluxRegister>(mesh);
  const amr::FieldTable& f = mesh.fields();
  now_ = {{f.find("psi").value()}, {f.find("c").value()}};
  first_ = {{f.find("psi_other").value()}, {f.find("c_other").value()}};
  v_.id = f.find("velocity_x").value();
}

void Transport::measure() {
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

double Transport::front_speed() {
  measure();
  return fastest_;
}

// v.grad phi of eq. (1).
void Transport::carry_phase(int b, const Moment& base, const Moment& from, const Moment& to, double dt) const {
  const amr::Layout& layout = mesh_->layout();
  const double scale = dt / (12.0 * mesh_->block(b).dx);
  amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
    const std::ptrdiff_t o = layout.offset(row);
    const double* p = mesh_->cells(from.psi, b) + o;
    const double* start = mesh_->cells(base.psi, b) + o;
    double* out = mesh_->cells(to.psi, b) + o;
    thread_local std::array<double, 32> change;
    change.fill(0);
    for (int a = 0; a < DIM; ++a) {
      const std::ptrdiff_t s = layout.stride(a);
      const double* v = mesh_->faces(v_, a, b) + o;
#pragma omp simd
      for (int i = 0; i < layout.n; ++i) {
        const double u = 0.5 * (v[i] + v[i + s]);
        const double centred = (p[i - 2 * s] - p[i + 2 * s]) + 8.0 * (p[i + s] - p[i - s]);
        const double fourth = (p[i - 2 * s] + p[i + 2 * s]) - 4.0 * (p[i - s] + p[i + s]) + 6.0 * p[i];
        change[static_cast<std::size_t>(i)] += u * centred + std::abs(u) * fourth;
      }
    }
    for (int i = 0; i < layout.n; ++i)
      out[i] = std::clamp(start[i] - scale * change[static_cast<std::size_t>(i)], -PSI_MAX, PSI_MAX);
  });
}

// div(v c) of eq. (2).
void Transport::carry_solute(int b, const Moment& base, const Moment& from, const Moment& to, double dt) {
  const amr::Layout& layout = mesh_->layout();
  const int n = layout.n;
  const double h = dt / mesh_->block(b).dx;
  const double* psi = mesh_->cells(from.psi, b);
  const double* c = mesh_->cells(from.c, b);
  double* next = mesh_->cells(to.c, b);
  Scratch& s = scratch();
  s.resize(layout.size());
  const std::ptrdiff_t origin = layout.interior();
  double *e = s.e.data() + origin, *u = s.u.data() + origin, *ratio = s.ratio.data() + origin,
         *flux = s.flux.data() + origin;
  const double k = k_;
#pragma omp simd
  for (std::ptrdiff_t q = -origin; q < layout.size() - origin; ++q) {
    const double x = fast_exp(psi[q] / SQRT2);
    e[q] = x;
    u[q] = c[q] * (1.0 + x * x) / (1.0 + k * x * x);
  }
  const double* start = mesh_->cells(base.c, b);
  amr::for_each_row(filled(n), [&](const IntVec& row) { std::copy_n(start + layout.offset(row), n, next + layout.offset(row)); });
  for (int axis = 0; axis < DIM; ++axis) {
    const std::ptrdiff_t a = layout.stride(axis);
    const double* v = mesh_->faces(v_, axis, b);
    // Contiguous ranges from the first to the last face needed, whatever lies between.
    IntVec lo{}, hi = filled(n - 1);
    lo[axis] = -1;
    hi[axis] = n + 1;
#pragma omp simd
    for (std::ptrdiff_t q = layout.offset(lo); q <= layout.offset(hi); ++q)
      ratio[q] = (1.0 + k * e[q] * e[q - a]) / (1.0 + e[q] * e[q - a]);  // A at the mean of two psi
    lo[axis] = 0;
    hi[axis] = n;
#pragma omp simd
    for (std::ptrdiff_t q = layout.offset(lo); q <= layout.offset(hi); ++q) {
      // psi at the face to fourth order, as a small step from the mean of two; dA/dpsi = -(1-k) sqrt2 r (1-r)
      const double r = 1.0 / (1.0 + e[q] * e[q - a]);
      const double bend = 0.0625 * ((psi[q] + psi[q - a]) - (psi[q + a] + psi[q - 2 * a]));
      const double centre = ratio[q] - (1.0 - k) * SQRT2 * r * (1.0 - r) * bend;
      // c is a point value: the difference of these fluxes is the derivative to fourth order.
      const double face = centre - (ratio[q + a] - 2.0 * ratio[q] + ratio[q - a]) / 24.0;
      const double du = u[q] - u[q - a];
      const double rightward = limited(u[q - a], u[q - a] - u[q - 2 * a], du);
      const double leftward = limited(u[q], u[q] - u[q + a], -du);
      flux[q] = v[q] * face * (v[q] > 0 ? rightward : leftward);
    }
    amr::for_each_row(filled(n), [&](const IntVec& row) {
      const std::ptrdiff_t o = layout.offset(row);
#pragma omp simd
      for (std::ptrdiff_t q = o; q < o + n; ++q) next[q] -= h * (flux[q + a] - flux[q]);
    });
    for (const int face : {2 * axis, 2 * axis + 1}) {
      double* out = fluxes_->store(b, face);
      if (out == nullptr) continue;
      IntVec first{}, extent = filled(n);
      first[axis] = face_is_high(face) ? n : 0;
      extent[axis] = 1;
      amr::for_each_cell(first, extent, [&](const IntVec& cell) { *out++ = flux[layout.offset(cell)]; });
    }
  }
}

void Transport::stage(const Moment& base, const Moment& from, const Moment& to, double dt) {
  ghosts_->fill_and_run({from.psi, from.c}, [&](int b) {
    carry_phase(b, base, from, to, dt);
    carry_solute(b, base, from, to, dt);
  });
}

void Transport::advance(double, double dt, std::int64_t) {
  measure();
  if (largest_rate_ == 0) return;
  fluxes_->prepare();
  const int steps = std::max(1, static_cast<int>(std::ceil(dt * largest_rate_ / COURANT - 1e-9)));
  for (int i = 0; i < steps; ++i) carry(dt / steps);
}

void Transport::carry(double dt) {
  stage(now_, now_, first_, dt / 3);
  stage(now_, first_, second_, dt / 2);
  stage(now_, second_, first_, dt);
  // Only the last stage's fluxes reach the next step, so only they must agree across levels.
  fluxes_->correct(first_.c, -dt);
  mesh_->swap(now_.psi, first_.psi);
  mesh_->swap(now_.c, first_.c);
}

}  // namespace dendrift::physics

#include "physics/flow.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"
#include "physics/motion.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

amr::FieldSpec velocity_field() {
  amr::FieldSpec f;
  f.name = "velocity";
  f.symbol = "v";
  f.unit = "W0/tau0";
  f.doc = "velocity, normal component on each face";
  return f;
}

}  // namespace

void FlowOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("flow", "motion of melt and crystals; without this table nothing moves");
  t.reals("velocity_um_s", velocity_um_s).unit("um/s").doc("uniform velocity, prescribed: nothing is solved; or velocity_W0_tau0");
  t.reals("velocity_W0_tau0", velocity_w0_tau0).unit("W0/tau0").doc("uniform velocity, prescribed: nothing is solved");
  t.real("viscosity_ratio", viscosity_ratio).range(1, 1e9).doc("viscosity of the solid over that of the melt");
  t.choice("viscosity", viscosity, {{"h3", ViscosityLaw::h3}, {"h2", ViscosityLaw::h2}, {"h1", ViscosityLaw::h1},
                                    {"linear", ViscosityLaw::linear}})
      .doc("how it goes from one to the other through the interface; linear is the print's");
  t.choice("stress", stress, {{"symmetric", Stress::symmetric}, {"laplacian", Stress::laplacian}})
      .doc("viscous stress; laplacian is the print's, in which a solid resists its own rotation");
  t.real("gravity_um_s2", gravity_um_s2).unit("um/s2").at_least(0).doc("acceleration of gravity, along -y in 2D and -z in 3D");
  t.real("solutal_expansion_per_wt", solutal_expansion_per_wt).unit("1/wt%").doc("relative density of the melt for 1 wt% of solute");
  t.real("solid_density_ratio", solid_density_ratio).above(0).doc("density of the solid over that of the melt");
  t.boolean("solutal_buoyancy", solutal_buoyancy).doc("solute makes the melt heavier");
  t.boolean("solid_weight", solid_weight).doc("the solid's density differs from the melt's");
  t.boolean("inertia", inertia).doc("v.grad v in the momentum equation");
  t.choice("buoyancy", buoyancy, {{"mixture", Buoyancy::mixture}, {"liquid", Buoyancy::liquid}})
      .doc("excess of solute inside the interface: c as it is (the print), or of liquid of the same U");
  t.real("tolerance", tolerance).range(1e-12, 0.1).doc("preconditioned residual of a solution over the norm of the velocity; crystals err by some 30 times as much");
  t.integer("max_iterations", max_iterations).at_least(1).doc("of a solution; more is a numerical failure");
  t.real("courant", courant).range(0.01, 10).doc("cells that the melt moves between two solutions at most");
  t.real("max_interval_tau0", max_interval_tau0).unit("tau0").above(0).doc("time between two solutions at most");
  t.real("max_change", max_change).range(1e-6, 10).doc("relative change of the velocity between two solutions aimed at");
  const char* sides[] = {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"};
  for (std::size_t f = 0; f < 6; ++f)
    t.reals(std::string(sides[f]) + "_velocity_W0_tau0", wall_velocity_w0_tau0[f])
        .unit("W0/tau0")
        .doc(f < 4 ? "velocity of this wall along itself" : "velocity of this wall along itself; 3D only");
  schema.check({"flow"}, [this](io::Checks& checks) {
    if (!checks.has_table("flow")) return;
    if (velocity_um_s && velocity_w0_tau0)
      checks.fail("flow", "at most one of velocity_um_s and velocity_W0_tau0", "both");
    for (int f = 0; f < FACES; ++f)
      if (const auto& v = wall_velocity_w0_tau0[at(f)]; v && (*v)[face_axis(f)] != 0)
        checks.fail("flow." + std::string("xyz"[face_axis(f)] + std::string(face_is_high(f) ? "hi" : "lo")) + "_velocity_W0_tau0",
                    "no component through the wall");
  });
}

double relative_viscosity(ViscosityLaw law, double ratio, double phi) {
  const double f = std::clamp(0.5 * (1 + phi), 0.0, 1.0);
  if (law == ViscosityLaw::linear) return f * ratio + (1 - f);
  const int n = law == ViscosityLaw::h1 ? 1 : law == ViscosityLaw::h2 ? 2 : 3;
  double a = f, b = 1 - f;
  for (int i = 1; i < n; ++i) {
    a *= f;
    b *= 1 - f;
  }
  // s/nu_s + (1-s)/nu_l, over the common denominator: exact also where 1-s is lost to round-off
  return (a + b) / (a / ratio + b);
}

PrescribedFlow::PrescribedFlow(const FlowOptions& o, const Scales& scales, std::vector<Seed>& crystals) {
  for (int a = 0; a < DIM; ++a)
    velocity_[a] = o.velocity_w0_tau0 ? (*o.velocity_w0_tau0)[a] : (*o.velocity_um_s)[a] * scales.tau0_s / scales.w0_um;
  for (Seed& g : crystals) g.velocity = velocity_;
}

void PrescribedFlow::declare(amr::FieldTable& fields) { v_ = fields.add_face(velocity_field()); }

void PrescribedFlow::after_regrid() {
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    for (int axis = 0; axis < DIM; ++axis) {
      double* v = mesh_->faces(v_, axis, b) - layout.interior();
      std::fill_n(v, layout.size(), velocity_[axis]);
    }
  });
}

void PrescribedFlow::report(Report& r) const {
  double square = 0;
  for (const double v : velocity_) square += v * v;
  r.max_speed = std::sqrt(square);
}

Flow::Flow(const FlowOptions& o, const Scales& s, std::vector<Seed>& crystals) : options_(o), scales_(s), crystals_(crystals) {
  const double time2 = s.tau0_s * s.tau0_s;
  solutal_ = o.solutal_buoyancy ? o.solutal_expansion_per_wt * s.c_l_wt : 0.0;
  weight_ = o.solid_weight ? o.solid_density_ratio - 1 : 0.0;
  gravity_[DIM - 1] = -o.gravity_um_s2 * time2 / s.w0_um;
}

void Flow::declare(amr::FieldTable& fields) {
  amr::FieldSpec v = velocity_field();
  v.transfer = amr::Transfer::conservative;
  v.checkpoint = true;
  v_ = fields.add_face(v);
  amr::FieldSpec p;
  p.name = "pressure";
  p.symbol = "p";
  p.unit = "W0^2/tau0^2";
  p.doc = "pressure over the density of the melt";
  p.transfer = amr::Transfer::conservative;
  p.checkpoint = true;
  pressure_ = fields.add_cell(p);
  v.name = "velocity_rate";
  v.symbol = "dv/dt";
  v.unit = "W0/tau0^2";
  v.doc = "change of the velocity in the last step of the flow: where the next one starts its search";
  v_rate_ = fields.add_face(v);
  p.name = "pressure_rate";
  p.symbol = "dp/dt";
  p.unit = "W0^2/tau0^3";
  p.doc = "the same of the pressure";
  pressure_rate_ = fields.add_cell(p);
}

void Flow::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  psi_ = {mesh.fields().find("psi").value()};
  c_ = {mesh.fields().find("c").value()};
}

void Flow::after_regrid() {
  solver_.reset();
  const std::span<const amr::BlockIndex> leaves = mesh_->tree().leaves();
  if (!recalled_ && !std::ranges::equal(leaves, leaves_)) due_ = true;  // blocks that only changed their rank change nothing
  leaves_.assign(leaves.begin(), leaves.end());
  recalled_ = false;
  // Faces that belong to others, and ghosts: neither a checkpoint nor a message holds them, and blocks to be refined need
  // them.
  load();
  solver_->fill_state();
  store(0);
}

std::vector<double> Flow::memory() const { return {last_, next_, interval_, fastest_, due_ ? 1.0 : 0.0}; }

void Flow::recall(const std::vector<double>& m) {
  last_ = m.at(0);
  next_ = m.at(1);
  interval_ = m.at(2);
  fastest_ = m.at(3);
  due_ = m.at(4) != 0;
  recalled_ = true;
}

void Flow::load() {
  if (solver_ == nullptr) {
    StokesOptions o;
    o.stress = options_.stress;
    o.tolerance = options_.tolerance;
    o.max_iterations = options_.max_iterations;
    solver_ = std::make_unique<StokesSolver>(*mesh_, o);
    for (int f = 0; f < FACES; ++f)
      if (const auto& v = options_.wall_velocity_w0_tau0[at(f)])
        for (int a = 0; a < DIM; ++a) solver_->set_wall_velocity(a, f, (*v)[a]);
  }
  amr::HierarchyField& state = solver_->state();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
    for (int a = 0; a < DIM; ++a) std::copy_n(mesh_->faces(v_, a, b) - origin, size, state.at(g, i, a) - origin);
    std::copy_n(mesh_->cells(pressure_, b) - origin, size, state.at(g, i, StokesSolver::PRESSURE) - origin);
  });
}

// Keeps the solution, and how fast it has changed since the last one.
void Flow::store(double elapsed) {
  const amr::HierarchyField& state = solver_->state();
  const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    const auto keep = [&](const double* now, double* old, double* rate) {
      for (std::ptrdiff_t q = -origin; q < size - origin; ++q) {
        if (elapsed > 0) rate[q] = (now[q] - old[q]) / elapsed;
        old[q] = now[q];
      }
    };
    for (int a = 0; a < DIM; ++a) keep(state.at(g, i, a), mesh_->faces(v_, a, b), mesh_->faces(v_rate_, a, b));
    keep(state.at(g, i, StokesSolver::PRESSURE), mesh_->cells(pressure_, b), mesh_->cells(pressure_rate_, b));
  });
}

// The first guess: what the last change would lead to if it went on.
void Flow::extrapolate(double elapsed) {
  amr::HierarchyField& state = solver_->state();
  const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    const auto advance = [&](double* x, const double* rate) {
      for (std::ptrdiff_t q = -origin; q < size - origin; ++q) x[q] += elapsed * rate[q];
    };
    for (int a = 0; a < DIM; ++a) advance(state.at(g, i, a), mesh_->faces(v_rate_, a, b));
    advance(state.at(g, i, StokesSolver::PRESSURE), mesh_->cells(pressure_rate_, b));
  });
}

void Flow::set_viscosity() {
  const amr::Layout& layout = mesh_->layout();
  solver_->set_viscosity(
      [&](int b, double* phi) {
        const double* psi = mesh_->cells(psi_, b) - layout.interior();
        double* out = phi - layout.interior();
        for (std::ptrdiff_t q = 0; q < layout.size(); ++q) out[q] = phi_of_psi(psi[q]);
      },
      [&](double phi) { return scales_.viscosity * relative_viscosity(options_.viscosity, options_.viscosity_ratio, phi); });
}

// Eqs. (5) and (6): what is known of the momentum at the end of the interval.
void Flow::set_force(double sigma) {
  const amr::Layout& layout = mesh_->layout();
  const double c0 = 1 - (1 - scales_.k) * scales_.supersaturation;  // c0/c_l
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    thread_local std::vector<double> heavy_array;
    heavy_array.resize(static_cast<std::size_t>(layout.size()));
    double* heavy = heavy_array.data() + layout.interior();
    const double *psi = mesh_->cells(psi_, b), *c = mesh_->cells(c_, b);
    for (std::ptrdiff_t q = -layout.interior(); q < layout.size() - layout.interior(); ++q) {
      const double phi = phi_of_psi(psi[q]);
      const double liquid = options_.buoyancy == Buoyancy::mixture ? c[q] : 1 + (1 - scales_.k) * u_of_c(c[q], phi, scales_.k);
      heavy[q] = 0.5 * (1 - phi) * solutal_ * (liquid - c0) + 0.5 * (1 + phi) * weight_;
    }
    for (int a = 0; a < DIM; ++a) {
      const std::ptrdiff_t s = layout.stride(a);
      const double* v = solver_->state().at(g, i, a);
      double* f = solver_->force().at(g, i, a);
      IntVec size = filled(layout.n);
      ++size[a];
      amr::for_each_cell({}, size, [&](const IntVec& q) {
        const std::ptrdiff_t o = layout.offset(q);
        f[o] = sigma * v[o] + gravity_[a] * 0.5 * (heavy[o] + heavy[o - s]);
      });
    }
    if (options_.inertia) add_inertia(b);
  });
}

// -v.grad v on the faces of a block: third order upwind where smooth, limited so that no new extremes arise.
void Flow::add_inertia(int b) {
  const amr::Layout& layout = mesh_->layout();
  const auto [g, i] = solver_->hierarchy().place_of_block(b);
  const double h = 1 / mesh_->block(b).dx;
  const amr::HierarchyField& state = solver_->state();
  for (int a = 0; a < DIM; ++a) {
    const double* v = state.at(g, i, a);
    double* f = solver_->force().at(g, i, a);
    IntVec size = filled(layout.n);
    ++size[a];
    amr::for_each_cell({}, size, [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      for (int e = 0; e < DIM; ++e) {
        const std::ptrdiff_t s = layout.stride(e), t = layout.stride(a);
        const double* u = state.at(g, i, e) + q;
        const double speed = e == a ? v[q] : 0.25 * ((u[0] + u[s]) + (u[-t] + u[s - t]));
        const std::ptrdiff_t d = speed > 0 ? -s : s;  // towards where the fluid comes from
        // The last face of a block has one face beyond it: first order there.
        const bool wide = cell[e] >= 1 && cell[e] < layout.n - 1 + (speed > 0 ? 1 : 0);
        double gradient = v[q] - v[q + d];
        if (wide) {
          const double ahead = v[q - d] - v[q], behind = v[q] - v[q + d], further = v[q + d] - v[q + 2 * d];
          const auto limited = [](double back, double front) {
            const double sign = back < 0 ? -1.0 : 1.0;
            return 0.5 * sign * std::max(0.0, std::min({2 * sign * front, sign * (back + 2 * front) / 3, 2 * sign * back}));
          };
          gradient = behind + limited(behind, ahead) - limited(further, behind);
        }
        f[q] -= std::abs(speed) * h * gradient;
      }
    });
  }
}

void Flow::solve(double elapsed) {
  ghosts_->fill({psi_, c_});
  load();
  solver_->fill_state();
  set_viscosity();
  const double sigma = 1 / elapsed;
  set_force(sigma);
  extrapolate(elapsed);
  result_ = solver_->solve(sigma);
  if (!result_.converged)
    throw NumericalError(fmt::format("the flow did not converge: error {:.2e} of {:.0e} asked for after {} iterations",
                                     result_.error, options_.tolerance, result_.iterations));
  double change = 0, fastest = 0;
  for (int b = 0; b < mesh_->size(); ++b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    for (int a = 0; a < DIM; ++a)
      amr::for_each_cell({}, filled(mesh_->layout().n), [&](const IntVec& q) {
        const double v = solver_->state().at(g, i, a)[mesh_->layout().offset(q)];
        change = std::max(change, std::abs(v - mesh_->faces(v_, a, b)[mesh_->layout().offset(q)]));
        fastest = std::max(fastest, std::abs(v));
      });
  }
  change = amr::global_max(change, mesh_->comm());
  fastest_ = amr::global_max(fastest, mesh_->comm());
  store(elapsed);
  // The interval after which the velocity will have changed as much as wanted, at the rate seen now.
  const double wanted = change > 0 ? elapsed * options_.max_change * fastest_ / change : options_.max_interval_tau0;
  const double dx = mesh_->shape().dx(mesh_->shape().max_level);
  interval_ = std::min({options_.max_interval_tau0, options_.courant * dx / std::max(fastest_, 1e-300),
                        std::max(wanted, 0.5 * interval_), interval_ > 0 ? 2 * interval_ : 1e300});
}

void Flow::advance(double t, double, std::int64_t) {
  const double elapsed = t - last_;
  if (elapsed <= 0) return;  // at rest at the start
  if (!due_ && t < next_ * (1 - 1e-12)) return;
  solve(elapsed);
  measure_motion(*mesh_, psi_, v_, crystals_);
  last_ = t;
  next_ = t + interval_;
  due_ = false;
}

void Flow::report(Report& r) const {
  r.max_speed = fastest_;
  r.divergence_max = result_.divergence_max;
  r.flow_iterations = result_.iterations;
}

}  // namespace dendrift::physics

#include "physics/flow.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numbers>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"
#include "physics/motion.hpp"
#include "physics/recall.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

constexpr std::array SIDES{"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"};

RealVec centre_of(const amr::MeshShape& shape) {
  RealVec c{};
  for (int a = 0; a < DIM; ++a) c[a] = 0.5 * (shape.lo[a] + shape.hi()[a]);
  return c;
}

double of_gradient(const Gradient& g, int component, int along) { return g[at(component * DIM + along)]; }

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
  t.reals("velocity_gradient_per_tau0", velocity_gradient_per_tau0)
      .unit("1/tau0")
      .doc("prescribed, on top of it: dvx/dx, dvx/dy, ..., dvy/dx, ... about the middle of the box; nothing is solved");
  t.choice("solid", solid, {{"viscous", SolidModel::viscous}, {"penalised", SolidModel::penalised}})
      .doc("what keeps crystals rigid: their viscosity, or a resistance against all that is not rigid motion");
  t.choice("motion", motion, {{"free", Motion::free}, {"held", Motion::held}})
      .doc("of crystals; held: a resistance keeps them in place, whatever `solid` says, and they weigh nothing");
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
  t.choice("coupling", coupling, {{"coupled", Coupling::coupled}, {"projection", Coupling::projection}})
      .doc("of velocity and pressure; projection: one after the other, wrong by the splitting and cheaper in no scene that was measured");
  t.integer("projections", projections).range(1, 100).doc("passes of each step with coupling = \"projection\"");
  t.boolean("rotational", rotational).doc("the projection's pressure takes -nu div v as well");
  t.real("tolerance", tolerance).range(1e-12, 0.1).doc("preconditioned residual of a solution over the norm of the velocity; crystals err by some 10 times as much");
  t.choice("bottom", bottom, {{"direct", amr::BottomSolver::direct}, {"hypre", amr::BottomSolver::hypre}})
      .doc("solver of the last grid of multigrid: a sparse factorization, or hypre's conjugate gradients with algebraic multigrid");
  t.integer("max_iterations", max_iterations).at_least(1).doc("of a solution; more is a numerical failure");
  t.integer("coarser_levels", coarser_levels)
      .range(0, 1)
      .doc("1: velocity and pressure are found without the finest level of the mesh, and interpolated there");
  t.real("courant", courant).range(0.01, 10).doc("cells that the melt moves between two solutions at most");
  t.real("max_interval_tau0", max_interval_tau0).unit("tau0").above(0).doc("time between two solutions at most");
  t.real("max_change", max_change).range(1e-6, 10).doc("relative change of the velocity between two solutions aimed at");
  for (std::size_t f = 0; f < 6; ++f)
    t.reals(std::string(SIDES[f]) + "_velocity_W0_tau0", wall_velocity_w0_tau0[f])
        .unit("W0/tau0")
        .doc(std::string("velocity on this wall; its component through the wall is in- or outflow") + (f < 4 ? "" : "; 3D only"));
  for (std::size_t f = 0; f < 6; ++f)
    t.choice(std::string(SIDES[f]) + "_profile", wall_profile[f], {{"uniform", Profile::uniform}, {"parabolic", Profile::parabolic}})
        .doc(std::string("of that velocity; parabolic: as given in the middle, 0 at the edges") + (f < 4 ? "" : "; 3D only"));
  t.reals("wall_gradient_per_tau0", wall_gradient_per_tau0)
      .unit("1/tau0")
      .doc("on all walls, on top of it: dvx/dx, dvx/dy, ..., dvy/dx, ... about the middle of the box");
  t.reals("initial_velocity_W0_tau0", initial_velocity_w0_tau0).unit("W0/tau0").doc("at the start, everywhere");
  t.real("initial_vortex_W0_tau0", initial_vortex_w0_tau0)
      .unit("W0/tau0")
      .doc("largest velocity of four vortices that fill the box at the start, on top of it (Taylor-Green)");
  schema.check({"flow"}, [this](io::Checks& checks) {
    if (!checks.has_table("flow")) return;
    if (velocity_um_s && velocity_w0_tau0)
      checks.fail("flow", "at most one of velocity_um_s and velocity_W0_tau0", "both");
    // What would be ignored without a word.
    const auto idle = [&](const std::string& key, bool asked, const char* where) {
      if (asked) checks.fail("flow." + key, where);
    };
    const char* solved = "no such key beside a prescribed velocity, with which nothing is solved";
    idle("motion", prescribed() && motion == Motion::held, solved);
    idle("coarser_levels", prescribed() && coarser_levels != 0, solved);
    idle("wall_gradient_per_tau0", prescribed() && wall_gradient_per_tau0.has_value(), solved);
    idle("initial_velocity_W0_tau0", prescribed() && initial_velocity_w0_tau0 != RealVec{}, solved);
    idle("initial_vortex_W0_tau0", prescribed() && initial_vortex_w0_tau0 != 0, solved);
    for (std::size_t f = 0; f < FACES; ++f) {
      idle(std::string(SIDES[f]) + "_velocity_W0_tau0", prescribed() && wall_velocity_w0_tau0[f].has_value(), solved);
      idle(std::string(SIDES[f]) + "_profile", wall_profile[f] == Profile::parabolic && !wall_velocity_w0_tau0[f],
           "a velocity of this wall, whose profile it is");
    }
    idle("projections", coupling == Coupling::coupled && projections > 1, "1, or coupling = \"projection\"");
    if (bottom == amr::BottomSolver::hypre && !amr::HypreSolver::available())
      checks.fail("flow.bottom", "\"direct\": this build has no hypre");
    if (!velocity_gradient_per_tau0) return;
    double trace = 0, largest = 0;
    for (int a = 0; a < DIM; ++a) {
      trace += of_gradient(*velocity_gradient_per_tau0, a, a);
      largest = std::max(largest, std::abs(of_gradient(*velocity_gradient_per_tau0, a, a)));
    }
    if (std::abs(trace) > 1e-12 * largest)
      checks.fail("flow.velocity_gradient_per_tau0", "no divergence: dvx/dx + dvy/dy + ... = 0", fmt::format("{:.6g}", trace));
  });
}

amr::SideValue FlowOptions::wall_value(const amr::MeshShape& shape, int axis, int face) const {
  amr::SideValue v;
  v.centre = centre_of(shape);
  if (const auto& given = wall_velocity_w0_tau0[at(face)]) v.constant = (*given)[axis];
  for (int a = 0; a < DIM; ++a) {
    if (wall_gradient_per_tau0) v.gradient[a] = of_gradient(*wall_gradient_per_tau0, axis, a);
    if (wall_profile[at(face)] == Profile::parabolic && a != face_axis(face)) v.half[a] = 0.5 * (shape.hi()[a] - shape.lo[a]);
  }
  return v;
}

bool FlowOptions::through_walls(const amr::MeshShape& shape) const {
  for (int a = 0; a < DIM; ++a) {  // a prescribed velocity heeds no sides
    if (shape.periodic()[a]) continue;
    if (velocity_um_s.value_or(RealVec{})[a] != 0 || velocity_w0_tau0.value_or(RealVec{})[a] != 0) return true;
    for (int b = 0; b < DIM && velocity_gradient_per_tau0; ++b)
      if (of_gradient(*velocity_gradient_per_tau0, a, b) != 0) return true;
  }
  for (int f = 0; f < FACES; ++f) {
    const int axis = face_axis(f);
    const amr::SideValue v = wall_value(shape, axis, f);
    if (shape.sides[at(f)] == amr::Side::wall && (v.constant != 0 || v.gradient != RealVec{})) return true;
  }
  return false;
}

void FlowOptions::check_sides(io::Checks& checks, const amr::MeshShape& shape) const {
  double net = 0, gross = 0;  // what flows out, all and in absolute value
  bool open = false;
  for (int f = 0; f < FACES; ++f) {
    open = open || shape.sides[at(f)] == amr::Side::open;
    const int axis = face_axis(f);
    const std::string key = std::string("flow.") + SIDES[at(f)] + "_velocity_W0_tau0";
    if (shape.sides[at(f)] != amr::Side::wall) {
      if (wall_velocity_w0_tau0[at(f)]) checks.fail(key, fmt::format("mesh.{} = \"wall\": only walls have a velocity", SIDES[at(f)]));
      continue;
    }
    RealVec x = centre_of(shape);
    x[axis] = face_is_high(f) ? shape.hi()[axis] : shape.lo[axis];
    amr::SideValue v = wall_value(shape, axis, f);
    double area = 1, part = 1;
    for (int a = 0; a < DIM; ++a) {
      if (a == axis) continue;
      area *= shape.hi()[a] - shape.lo[a];
      if (v.half[a] > 0) part *= 2.0 / 3;
      v.half[a] = 0;
    }
    v.constant *= part;
    net += (face_is_high(f) ? area : -area) * v.at(x, 0);
    gross += area * std::abs(v.at(x, 0));
  }
  if (!open && std::abs(net) > 1e-12 * gross)
    checks.fail("flow", "no net flow through the sides, or a side that is open",
                fmt::format("{:.6g} W0^{}/tau0 flowing {}", std::abs(net), DIM, net > 0 ? "out" : "in"));
  for (int a = 0; a < DIM; ++a) {
    if (!shape.periodic()[a]) continue;
    for (int c = 0; c < DIM; ++c) {
      const std::string expected = fmt::format("no change along {}, which is periodic", "xyz"[a]);
      if (wall_gradient_per_tau0 && of_gradient(*wall_gradient_per_tau0, c, a) != 0)
        checks.fail("flow.wall_gradient_per_tau0", expected);
      if (velocity_gradient_per_tau0 && of_gradient(*velocity_gradient_per_tau0, c, a) != 0)
        checks.fail("flow.velocity_gradient_per_tau0", expected);
    }
  }
  if (initial_vortex_w0_tau0 != 0)
    for (int f = 0; f < 4; ++f)
      if (const amr::Side s = shape.sides[at(f)]; s != amr::Side::periodic && s != amr::Side::symmetry)
        checks.fail("flow.initial_vortex_W0_tau0", "sides in x and y that are periodic or symmetry");
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

double relative_drag(double phi) {
  const double f = std::clamp(0.5 * (1 + phi), 0.0, 1.0), l = 1 - f;
  constexpr double SLOPE = 0.63 * 9, MOST = 100, NOTHING = 1e-6;
  const double drag = SLOPE * f * f * f;
  const double melt = l * l * l;
  if (drag >= MOST * melt) return MOST;
  return drag > NOTHING * melt ? drag / melt : 0.0;
}

PrescribedFlow::PrescribedFlow(const FlowOptions& o, const Scales& scales, std::vector<Seed>& crystals) : crystals_(crystals) {
  for (int a = 0; a < DIM; ++a) {
    if (o.velocity_w0_tau0) velocity_[a] = (*o.velocity_w0_tau0)[a];
    if (o.velocity_um_s) velocity_[a] = (*o.velocity_um_s)[a] * scales.tau0_s / scales.w0_um;
  }
  if (o.velocity_gradient_per_tau0) gradient_ = *o.velocity_gradient_per_tau0;
}

void PrescribedFlow::attach(amr::Mesh& mesh, amr::GhostExchange&) {
  mesh_ = &mesh;
  for (Seed& g : crystals_) {
    g.velocity = velocity_at(g.position);
    for (int axis = DIM == 2 ? 2 : 0; axis < 3; ++axis) {  // half the curl
      const int a = (axis + 1) % 3, e = (axis + 2) % 3;
      g.spin[at(axis)] = 0.5 * (of_gradient(gradient_, e, a) - of_gradient(gradient_, a, e));
    }
  }
}

RealVec PrescribedFlow::velocity_at(const RealVec& x) const {
  const RealVec centre = centre_of(mesh_->shape());
  RealVec v = velocity_;
  for (int c = 0; c < DIM; ++c)
    for (int a = 0; a < DIM; ++a) v[c] += of_gradient(gradient_, c, a) * (x[a] - centre[a]);
  return v;
}

void PrescribedFlow::declare(amr::FieldTable& fields) { v_ = fields.add_face(velocity_field()); }

void PrescribedFlow::after_regrid() {
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    for (int axis = 0; axis < DIM; ++axis) {
      double* v = mesh_->faces(v_, axis, b);
      const amr::Block& block = mesh_->block(b);
      amr::for_each_cell(filled(-amr::Layout::GHOSTS), filled(layout.pitch()), [&](const IntVec& q) {
        RealVec x{};
        for (int a = 0; a < DIM; ++a) x[a] = block.lo[a] + (q[a] + (a == axis ? 0.0 : 0.5)) * block.dx;
        v[layout.offset(q)] = velocity_at(x)[axis];
      });
    }
  });
}

void PrescribedFlow::advance(double, double dt, std::int64_t) {
  for (Seed& g : crystals_) {  // the velocity halfway through the step
    const RealVec now = velocity_at(g.position);
    RealVec x = g.position;
    for (int a = 0; a < DIM; ++a) x[a] += 0.5 * dt * now[a];
    g.velocity = velocity_at(x);
  }
}

void PrescribedFlow::report(Report& r) const {
  for (int corner = 0; corner < CHILDREN; ++corner) {
    RealVec x{};
    for (int a = 0; a < DIM; ++a) x[a] = (corner >> a & 1) != 0 ? mesh_->shape().hi()[a] : mesh_->shape().lo[a];
    double square = 0;
    for (const double v : velocity_at(x)) square += v * v;
    r.max_speed = std::max(r.max_speed, std::sqrt(square));
  }
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
  phase_.v = fields.add_face(v);
  amr::FieldSpec p;
  p.name = "pressure";
  p.symbol = "p";
  p.unit = "W0^2/tau0^2";
  p.doc = "pressure over the density of the melt";
  p.transfer = amr::Transfer::conservative;
  p.checkpoint = true;
  phase_.pressure = fields.add_cell(p);
  v.name = "velocity_rate";
  v.symbol = "dv/dt";
  v.unit = "W0/tau0^2";
  v.doc = "change of the velocity in the last step of the flow: where the next one starts its search";
  phase_.v_rate = fields.add_face(v);
  p.name = "pressure_rate";
  p.symbol = "dp/dt";
  p.unit = "W0^2/tau0^3";
  p.doc = "the same of the pressure";
  phase_.pressure_rate = fields.add_cell(p);
}

void Flow::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  phase_mesh_ = mesh_ = &mesh;
  phase_ghosts_ = &ghosts;
  phase_.psi = {mesh.fields().find("psi").value()};
  phase_.c = {mesh.fields().find("c").value()};
  phase_.grain = {mesh.fields().find("grain").value_or(-1)};
}

// A uniform velocity and v = curl of (U/k_y) sin(k_x x) sin(k_y y), as differences of what stands at edges: free of
// divergence on every mesh.
void Flow::initialize() {
  const amr::Layout& layout = phase_mesh_->layout();
  const RealVec lo = phase_mesh_->shape().lo, hi = phase_mesh_->shape().hi();
  const double kx = 2 * std::numbers::pi / (hi[0] - lo[0]), ky = 2 * std::numbers::pi / (hi[1] - lo[1]);
  amr::parallel_for(phase_mesh_->size(), [&](int b) {
    const amr::Block& block = phase_mesh_->block(b);
    const auto stream = [&](double x, double y) {
      return options_.initial_vortex_w0_tau0 / ky * std::sin(kx * (x - lo[0])) * std::sin(ky * (y - lo[1]));
    };
    for (int a = 0; a < DIM; ++a) {
      double* v = phase_mesh_->faces(phase_.v, a, b);
      IntVec size = filled(layout.n);
      ++size[a];
      amr::for_each_cell({}, size, [&](const IntVec& q) {
        const double x = block.lo[0] + q[0] * block.dx, y = block.lo[1] + q[1] * block.dx;
        double value = options_.initial_velocity_w0_tau0[a];
        if (options_.initial_vortex_w0_tau0 != 0 && a == 0) value += (stream(x, y + block.dx) - stream(x, y)) / block.dx;
        if (options_.initial_vortex_w0_tau0 != 0 && a == 1) value -= (stream(x + block.dx, y) - stream(x, y)) / block.dx;
        v[layout.offset(q)] = value;
      });
    }
  });
}

void Flow::after_regrid() {
  const std::span<const amr::BlockIndex> leaves = phase_mesh_->tree().leaves();
  if (!recalled_ && !std::ranges::equal(leaves, leaves_)) due_ = true;  // blocks that only changed their rank change nothing
  leaves_.assign(leaves.begin(), leaves.end());
  recalled_ = false;
  solver_.reset();
  choose_mesh();
  make_solver();
  // Neither a checkpoint nor a message holds ghosts, and blocks to be refined need them.
  complete();
}

// Where to solve: on the mesh of the phase, or on the one without its finest level.
void Flow::choose_mesh() {
  mesh_ = phase_mesh_;
  ghosts_ = phase_ghosts_;
  now_ = phase_;
  if (options_.coarser_levels == 0) return;
  const amr::FieldTable& rows = phase_mesh_->fields();
  amr::FieldTable table;
  const auto cells = [&](amr::CellField f) { return table.add_cell(rows.row(f.id)); };
  const auto if_any = [&](amr::CellField f) { return f.id < 0 ? f : cells(f); };
  now_ = {cells(phase_.psi), cells(phase_.c), if_any(phase_.grain), cells(phase_.pressure), cells(phase_.pressure_rate), {}, {}};
  amr::FieldSpec faces;
  for (const auto& [name, field] : {std::pair{"velocity", &now_.v}, std::pair{"velocity_rate", &now_.v_rate}}) {
    faces.name = name;
    *field = table.add_face(faces);
  }
  coarser_ = std::make_unique<amr::CoarserMesh>(*phase_mesh_, table);
  mesh_ = &coarser_->mesh();
  coarser_ghosts_ = std::make_unique<amr::GhostExchange>(*mesh_);
  ghosts_ = coarser_ghosts_.get();
}

std::vector<double> Flow::memory() const {
  return {last_, next_, interval_, fastest_, due_ ? 1.0 : 0.0, result_.divergence_max,
          static_cast<double>(result_.iterations), unbalanced_};
}

void Flow::recall(const std::vector<double>& m) {
  last_ = m.at(0);
  next_ = m.at(1);
  interval_ = m.at(2);
  fastest_ = m.at(3);
  due_ = m.at(4) != 0;
  if (m.size() > 5) {  // what diagnostics.csv says until the next solution; older checkpoints lack it
    result_.divergence_max = m.at(5);
    result_.iterations = remembered_count(m, 6);
    unbalanced_ = m.at(7);
  }
  recalled_ = true;
}

void Flow::be_careful() {
  constexpr double SMALLER = 1e-3;
  interval_ *= SMALLER;
  due_ = true;
}

// f(grid, node, component, values, rates): for the arrays of velocity and pressure of every block, from their first ghost on.
template <class F>
void Flow::for_arrays(F&& f) {
  const std::ptrdiff_t origin = mesh_->layout().interior();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    for (int a = 0; a < DIM; ++a) f(g, i, a, mesh_->faces(now_.v, a, b) - origin, mesh_->faces(now_.v_rate, a, b) - origin);
    f(g, i, StokesSolver::PRESSURE, mesh_->cells(now_.pressure, b) - origin, mesh_->cells(now_.pressure_rate, b) - origin);
  });
}

void Flow::make_solver() {
  StokesOptions o;
  o.stress = penalised() ? Stress::laplacian : options_.stress;  // the same where the viscosity is uniform
  o.tolerance = tolerance();
  o.max_iterations = options_.max_iterations;
  o.coupling = options_.coupling;
  o.passes = options_.projections;
  o.rotational = options_.rotational;
  o.bottom = options_.bottom;
  solver_ = std::make_unique<StokesSolver>(*mesh_, o);
  for (int f = 0; f < FACES; ++f)
    for (int a = 0; a < DIM && mesh_->shape().sides[at(f)] == amr::Side::wall; ++a)
      solver_->set_wall_velocity(a, f, options_.wall_value(mesh_->shape(), a, f));
}

void Flow::load() {
  const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
  for_arrays([&](int g, int i, int c, const double* value, const double*) {
    std::copy_n(value, size, solver_->state().at(g, i, c) - origin);
  });
  solver_->fill_state();
}

// The same residual hides an error of a crystal's velocity that grows with the ratio of the viscosities: .1 % at 1e6, 2 %
// at 1e7, a factor of eight at 1e9.
double Flow::tolerance() const {
  constexpr double USUAL_RATIO = 1e6, FINEST = 1e-9;
  const double tightened = options_.tolerance * std::min(1.0, USUAL_RATIO / options_.viscosity_ratio);
  return penalised() ? options_.tolerance : std::max(tightened, std::min(options_.tolerance, FINEST));
}

// Keeps the solution, and how fast it has changed since the last one; elapsed 0: leaves the rates as they are.
void Flow::store(double elapsed) {
  const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
  for_arrays([&](int g, int i, int c, double* value, double* rate) {
    const double* now = solver_->state().at(g, i, c) - origin;
    for (std::ptrdiff_t q = 0; q < size; ++q) {
      if (elapsed > 0) rate[q] = (now[q] - value[q]) / elapsed;
      value[q] = now[q];
    }
  });
}

// Ghosts of velocity, pressure and their rates, and faces that belong to others: always from the same numbers, those that a
// checkpoint holds.
void Flow::complete() {
  const amr::FieldList all{{now_.pressure, now_.pressure_rate}, {now_.v, now_.v_rate}};
  if (coarser_ != nullptr) coarser_->take(all);
  load();
  store(0);
  amr::HierarchyField& scratch = solver_->force();
  const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
  for_arrays([&](int g, int i, int c, const double*, const double* rate) {
    std::copy_n(rate, size, scratch.at(g, i, c) - origin);
  });
  solver_->hierarchy().make_composite(scratch, amr::Layout::GHOSTS, true);
  for_arrays([&](int g, int i, int c, const double*, double* rate) {
    double* from = scratch.at(g, i, c) - origin;
    std::copy_n(from, size, rate);
    std::fill_n(from, size, 0.0);  // nothing is to force the divergence
  });
  if (coarser_ != nullptr) coarser_->give_common(all);
}

// The first guess: what the last change would lead to if it went on.
void Flow::extrapolate(double elapsed) {
  const std::ptrdiff_t origin = mesh_->layout().interior(), size = mesh_->layout().size();
  for_arrays([&](int g, int i, int c, const double*, const double* rate) {
    double* x = solver_->state().at(g, i, c) - origin;
    for (std::ptrdiff_t q = 0; q < size; ++q) x[q] += elapsed * rate[q];
  });
}

void Flow::set_viscosity() {
  const amr::Layout& layout = mesh_->layout();
  const auto phase = [&](int b, double* phi) {
    const double* psi = mesh_->cells(now_.psi, b) - layout.interior();
    double* out = phi - layout.interior();
    for (std::ptrdiff_t q = 0; q < layout.size(); ++q) out[q] = phi_of_psi(psi[q]);
  };
  const double nu = scales_.viscosity, ratio = penalised() ? 1.0 : options_.viscosity_ratio;
  solver_->set_viscosity(phase, [&](double phi) { return nu * relative_viscosity(options_.viscosity, ratio, phi); });
  if (!penalised()) return;
  std::vector<RealVec> centres;
  RigidBodies::Owners owners;
  for (const Seed& crystal : crystals_) {
    owners.body.push_back(held(crystal) ? RigidBodies::HELD : static_cast<int>(centres.size()));
    if (!held(crystal)) centres.push_back(crystal.position);
  }
  if (now_.grain.id >= 0) owners.label = [this](int b) { return mesh_->cells(now_.grain, b); };
  solver_->set_drag(phase, [&](double phi) { return nu * relative_drag(phi); }, centres, owners);
}

void Flow::set_crystals() {
  Neighbourhood found = find_neighbourhood(*mesh_, now_.psi, now_.grain, crystals_);
  bodies_ = found.body;
  const bool free = options_.coupling == Coupling::coupled && !penalised() && options_.stress == Stress::symmetric;
  solver_->set_crystals(free ? std::move(found) : Neighbourhood());
}

// Eqs. (5) and (6): what is known of the momentum at the end of the interval.
void Flow::set_force(double sigma) {
  const amr::Layout& layout = mesh_->layout();
  const double c0 = 1 - (1 - scales_.k) * scales_.supersaturation;  // c0/c_l
  std::vector<double> weights;  // of each crystal
  for (const Seed& crystal : crystals_) weights.push_back(held(crystal) ? 0.0 : weight_);
  if (weights.empty()) weights.push_back(0);
  const bool alike = std::ranges::all_of(weights, [&](double w) { return w == weights[0]; });
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    thread_local std::vector<double> heavy_array;
    heavy_array.resize(static_cast<std::size_t>(layout.size()));
    double* heavy = heavy_array.data() + layout.interior();
    const double *psi = mesh_->cells(now_.psi, b), *c = mesh_->cells(now_.c, b);
    const double* grain = alike || now_.grain.id < 0 ? nullptr : mesh_->cells(now_.grain, b);
    for (std::ptrdiff_t q = -layout.interior(); q < layout.size() - layout.interior(); ++q) {
      const double phi = phi_of_psi(psi[q]);
      const double liquid = options_.buoyancy == Buoyancy::mixture ? c[q] : 1 + (1 - scales_.k) * u_of_c(c[q], phi, scales_.k);
      const double weight = grain == nullptr ? weights[0] : weights[static_cast<std::size_t>(grain[q])];
      heavy[q] = 0.5 * (1 - phi) * solutal_ * (liquid - c0) + 0.5 * (1 + phi) * weight;
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
  Array<const double*> velocity;
  for (int a = 0; a < DIM; ++a) velocity[a] = std::as_const(solver_->state()).at(g, i, a);
  for (int a = 0; a < DIM; ++a) {
    const double* v = velocity[a];
    double* f = solver_->force().at(g, i, a);
    IntVec size = filled(layout.n);
    ++size[a];
    amr::for_each_cell({}, size, [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      for (int e = 0; e < DIM; ++e) {
        const std::ptrdiff_t s = layout.stride(e), t = layout.stride(a);
        const double* u = velocity[e] + q;
        const double speed = e == a ? v[q] : 0.25 * ((u[0] + u[s]) + (u[-t] + u[s - t]));
        const std::ptrdiff_t d = speed > 0 ? -s : s;  // towards where the fluid comes from
        // The high side of a block has one face beyond it: first order there, against the axis.
        const bool wide = speed > 0 || cell[e] < layout.n;
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

// Axes along which nothing stops the melt as a whole: there a mean pressure gradient balances the forces.
Array<bool> Flow::unheld() const {
  const auto& sides = mesh_->shape().sides;
  const bool held = std::ranges::any_of(sides, [](amr::Side s) { return s == amr::Side::wall || s == amr::Side::open; });
  Array<bool> axes = mesh_->shape().periodic();
  for (bool& a : axes) a = a && !held;
  return axes;
}

// Of values on faces, over the box.
RealVec Flow::means(const amr::HierarchyField& f) const {
  std::vector<std::array<double, DIM>> parts(at(mesh_->size()));
  double box = 1;
  for (int a = 0; a < DIM; ++a) box *= mesh_->shape().hi()[a] - mesh_->shape().lo[a];
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    const amr::Layout& layout = mesh_->layout();
    for (int a = 0; a < DIM; ++a) {
      const double* x = f.at(g, i, a);
      double sum = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
        const std::ptrdiff_t o = layout.offset(q);
        sum += 0.5 * (x[o] + x[o + layout.stride(a)]);
      });
      parts[at(b)][at(a)] = sum * std::pow(mesh_->block(b).dx, DIM) / box;
    }
  });
  std::vector<amr::ExactSum> total(DIM);
  for (const auto& part : parts)
    for (std::size_t a = 0; a < DIM; ++a) total[a].add(part[a]);
  const std::vector<double> all = amr::exact_sums(total, mesh_->comm());
  RealVec mean{};
  std::copy_n(all.begin(), DIM, mean.begin());
  return mean;
}

void Flow::shift(amr::HierarchyField& f, const RealVec& by, const Array<bool>& axes) {
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    for (int a = 0; a < DIM; ++a) {
      if (!axes[a]) continue;
      double* x = f.at(g, i, a) - layout.interior();
      for (std::ptrdiff_t q = 0; q < layout.size(); ++q) x[q] += by[a];
    }
  });
}

// The true residual, in the norms that tell how wrong crystals move: of each that is free, with those that it is frozen to, the
// error of its velocity, and of its spin times its radius, for the drag of a disc (2D, without the logarithm) or a sphere of
// that size; over the largest speed.
double Flow::unbalanced() const {
  if (!(fastest_ > 0)) return 0;
  const std::vector<Load> loads = net_loads(*mesh_, now_.psi, now_.grain, crystals_, [&](int b, int axis) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    return solver_->residual().at(g, i, axis);
  });
  struct Body {
    double volume = 0;
    RealVec moment{};  // of volume about the first crystal's centre, as the torque
    Load load;
  };
  std::vector<Body> bodies(crystals_.size());
  for (std::size_t g = 0; g < crystals_.size(); ++g) {
    const int first = bodies_[g];
    if (!(crystals_[g].volume > 0) || held(crystals_[g]) || first == Neighbourhood::FIXED) continue;
    Body& body = bodies[at(first)];
    const RealVec r = mesh_->shape().way(crystals_[at(first)].position, crystals_[g].position);
    const std::array<double, 3> lever = moment(r, loads[g].force);
    body.volume += crystals_[g].volume;
    for (int a = 0; a < DIM; ++a) {
      body.moment[a] += crystals_[g].volume * r[a];
      body.load.force[a] += loads[g].force[a];
    }
    for (std::size_t a = 0; a < 3; ++a) body.load.torque[a] += loads[g].torque[a] + lever[a];
  }
  double most = 0;
  for (const Body& body : bodies) {
    if (!(body.volume > 0)) continue;
    RealVec centre = body.moment;
    for (double& x : centre) x /= body.volume;
    const std::array<double, 3> lever = moment(centre, body.load.force);
    const double radius = DIM == 2 ? std::sqrt(body.volume / std::numbers::pi) : std::cbrt(0.75 / std::numbers::pi * body.volume);
    const double drag = DIM == 2 ? 4 * std::numbers::pi : 6 * std::numbers::pi * radius;
    const double turning = DIM == 2 ? 4 * std::numbers::pi * radius : 8 * std::numbers::pi * radius * radius;  // torque per speed of the surface
    double force = 0, torque = 0;
    for (const double f : body.load.force) force += f * f;
    for (std::size_t a = 0; a < 3; ++a) torque += std::pow(body.load.torque[a] - lever[a], 2);
    // A torque tells the error of the spin to the percent. A force overstates that of the velocity twenty times: the melt around
    // is left with one to the other side.
    constexpr double OF_FORCE = 0.1;
    most = std::max(most, std::max(OF_FORCE * std::sqrt(force) / drag, std::sqrt(torque) / turning) / (scales_.viscosity * fastest_));
  }
  return most;
}

void Flow::solve(double elapsed) {
  std::vector<amr::CellField> seen{now_.psi, now_.c};
  if (now_.grain.id >= 0) seen.push_back(now_.grain);
  if (coarser_ != nullptr) coarser_->take({seen, {}});
  ghosts_->fill(seen);
  load();
  set_viscosity();
  set_crystals();
  const double sigma = 1 / elapsed;
  set_force(sigma);
  const Array<bool> unheld_axes = unheld();
  const bool any_unheld = std::ranges::find(unheld_axes, true) != unheld_axes.end();
  RealVec drift{};
  if (any_unheld) {
    drift = means(solver_->state());
    RealVec excess = means(solver_->force());
    for (int a = 0; a < DIM; ++a) excess[a] = sigma * drift[a] - excess[a];
    shift(solver_->force(), excess, unheld_axes);
  }
  if (options_.coupling == Coupling::coupled) extrapolate(elapsed);  // a projection starts from the old pressure
  result_ = solver_->solve(sigma);
  fastest_ = result_.fastest;
  unbalanced_ = unbalanced();
  if (!std::isfinite(result_.error))
    throw NumericalError("the flow is not finite: phi, c or the velocity before were not, or gravity is beyond all bounds");
  if (!result_.converged)
    throw NumericalError(fmt::format("the flow did not converge: error {:.2e} of {:.0e} asked for after {} iterations",
                                     result_.error, tolerance(), result_.iterations));
  if (any_unheld) {  // to the last digit: a little force left over would add up
    const RealVec now = means(solver_->state());
    for (int a = 0; a < DIM; ++a) drift[a] -= now[a];
    shift(solver_->state(), drift, unheld_axes);
  }
  double change = 0;
  for (int b = 0; b < mesh_->size(); ++b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    for (int a = 0; a < DIM; ++a) {
      const double *v = solver_->state().at(g, i, a), *before = mesh_->faces(now_.v, a, b);
      amr::for_each_cell({}, filled(mesh_->layout().n), [&](const IntVec& q) {
        const std::ptrdiff_t o = mesh_->layout().offset(q);
        change = std::max(change, std::abs(v[o] - before[o]));
      });
    }
  }
  change = amr::global_max(change, mesh_->comm());
  store(elapsed);
  if (coarser_ != nullptr) coarser_->give({{now_.pressure, now_.pressure_rate}, {now_.v, now_.v_rate}});
  complete();
  // The interval after which the velocity will have changed as much as wanted, at the rate seen now.
  const double wanted = change > 0 ? elapsed * options_.max_change * fastest_ / change : options_.max_interval_tau0;
  const double dx = phase_mesh_->shape().dx(phase_mesh_->shape().max_level);
  interval_ = std::min({options_.max_interval_tau0, options_.courant * dx / std::max(fastest_, 1e-300),
                        std::max(wanted, 0.5 * interval_), interval_ > 0 ? 2 * interval_ : 1e300});
}

// Inertia is explicit, and crystals move at the end of a step as they did at its start.
double Flow::max_dt() const {
  return options_.courant * phase_mesh_->shape().dx(phase_mesh_->shape().max_level) / std::max(fastest_, 1e-300);
}

void Flow::advance(double t, double dt, std::int64_t) {
  // At rest at the start, unless walls push melt in: it must go somewhere from the first step on.
  const double elapsed = t > last_ ? t - last_ : t == 0 && options_.through_walls(phase_mesh_->shape()) ? dt : 0;
  if (elapsed <= 0) return;
  if (!due_ && t < next_ * (1 - 1e-12)) return;
  solve(elapsed);
  // The step was chosen for the velocity before.
  constexpr double MOST_CELLS = 10;
  const double cells = fastest_ * dt / phase_mesh_->shape().dx(phase_mesh_->shape().max_level);
  if (cells > MOST_CELLS * std::max(1.0, options_.courant))
    throw NumericalError(fmt::format("the flow has become too fast for the step: {:.3g} cells in {:.3g} tau0; a smaller "
                                     "phase_field.max_dt_tau0 may help", cells, dt));
  measure_motion(*phase_mesh_, phase_.psi, phase_.grain, phase_.v, crystals_);
  for (Seed& crystal : crystals_)
    if (held(crystal)) {
      crystal.velocity = {};
      crystal.spin = {};
      crystal.nonrigidity = 0;
    }
  last_ = t;
  next_ = t + interval_;
  due_ = false;
}

void Flow::report(Report& r) const {
  r.max_speed = fastest_;
  r.divergence_max = result_.divergence_max;
  r.flow_iterations = result_.iterations;
  r.flow_residual = unbalanced_;
}

}  // namespace dendrift::physics

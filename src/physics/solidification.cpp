#include "physics/solidification.hpp"

#include <fmt/format.h>

#include <omp.h>

#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"

namespace dendrift::physics {

namespace {
constexpr int MAX_STAGES = 40;
}

Solidification::Solidification(const PhaseFieldOptions& phase, const SoluteOptions& solute, const Scales& scales,
                               const std::vector<Seed>& crystals)
    : phase_(phase), solute_(solute), scales_(scales), crystals_(crystals) {
  parameters_.k = scales.k;
  parameters_.lambda = scales.lambda;
  parameters_.diffusivity = scales.diffusivity;
  parameters_.epsilon = phase.anisotropy;
  parameters_.antitrapping = solute.antitrapping;
  turn_axes();
}

void Solidification::turn_axes() {
  if (crystals_.empty()) {
    for (int a = 0; a < DIM; ++a) parameters_.axes[a][a] = 1;
    return;
  }
  parameters_.axes = crystals_.front().axes;
  parameters_.rotated = crystals_.front().rotated;
}

void Solidification::declare(amr::FieldTable& fields) {
  psi_ = fields.add_cell(psi_field());
  c_ = fields.add_cell(solute_field());
  amr::FieldSpec scratch;
  scratch.doc = "the stage before; scratch";
  scratch.name = "psi_other";
  psi_other_ = fields.add_cell(scratch);
  scratch.name = "c_other";
  c_other_ = fields.add_cell(scratch);
}

namespace {

// Largest eigenvalue across the interface, in units of that along it, of the solute's 2 DIM + 1 point Laplacian of U = c/A:
// the faces see (1-phi)/2 half a cell away, which for small k and coarse cells outweighs A = k + (1-k)(1-phi)/2.
double stiffness_across(double k, double dx) {
  double across = 1;
  for (double psi = -8; psi < 8; psi += 0.05) {
    const auto liquid = [](double x) { return 1 / (1 + std::exp(SQRT2 * x)); };
    const double a = k + (1 - k) * liquid(psi);
    across = std::max(across, 0.5 * (liquid(psi - 0.5 * dx) + liquid(psi + 0.5 * dx)) / a);
  }
  return across;
}

}  // namespace

void Solidification::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  fluxes_ = std::make_unique<amr::FluxRegister>(mesh);
  local_axes_.attach(mesh, ghosts);
  across_ = stiffness_across(parameters_.k, mesh.shape().dx(mesh.shape().max_level));
  if (const auto v = mesh.fields().find("velocity_x")) velocity_.id = *v;
}

void Solidification::initialize() { draw(crystals_); }

void Solidification::draw(const std::vector<Seed>& crystals) {
  amr::parallel_for(mesh_->size(), [&](int b) {
    set_seeds(*mesh_, psi_, crystals, b);
    set_uniform_supersaturation(*mesh_, psi_, c_, scales_, b);
  });
}

double Solidification::explicit_limit() const {
  const double dx = mesh_->shape().dx(mesh_->shape().max_level);
  const double solute = 4.0 * (across_ + DIM - 1) * parameters_.diffusivity;
  // The phase: (a_s + a_s'')/a_s along the interface times the isotropic Laplacian's 16/3; in 3D with a margin for
  // the anisotropic terms, which use plain differences.
  const double stiffness = (1 + 15 * phase_.anisotropy) / (1 - phase_.anisotropy);
  double phase = (DIM == 2 ? 16.0 / 3 : 8.0) * stiffness;
  // Where grains meet: the derivative of the pull of disorder, w/[sqrt2 (1-phi)], by psi is -sqrt2 times the pull.
  if (local_axes_.active()) phase += SQRT2 * FASTEST_PULL * dx * dx;
  constexpr double SAFETY = 0.9;
  return 2 * SAFETY * dx * dx / std::max(solute, phase);
}

double Solidification::sharpening_limit(int s) const {
  // The term sqrt2 phi (1 - a_s^2 |grad psi|^2) carries disturbances of psi away from the interface at a speed of
  // 2 sqrt2 |grad psi|. With diffusion of unit strength and amplification 1 + z + alpha z^2 + ... a step stays stable
  // up to 1/[4 (1 - 2 alpha) |grad psi|^2], whatever the spacing. Ahead of a front of speed V, |grad psi| =
  // (V + sqrt(V^2+8))/sqrt 8. One stage at the very limit was seen to slow a front down by 20 %: keep well away.
  const double alpha = (s - 1.0) * (s + 2.0) / (4.0 * s * (s + 1.0));
  const double gradient = (fastest_ + std::sqrt(fastest_ * fastest_ + 8)) / std::sqrt(8.0);
  constexpr double SAFETY = 0.6;
  return SAFETY / (4 * (1 - 2 * alpha) * gradient * gradient);
}

double Solidification::largest_step(int s) const {
  return std::min({explicit_limit() * (s * s + s) / 2, sharpening_limit(s), phase_.max_dt_tau0});
}

int Solidification::stages(double dt) const {
  int s = 1;
  while (s < MAX_STAGES && largest_step(s) < dt * (1 - 1e-9)) ++s;
  return s;
}

double Solidification::max_dt() const {
  if (phase_.frozen) return phase_.max_dt_tau0;
  // The number of stages that costs least per unit of time.
  double best = 0, rate = 1e300;
  for (int s = 1; s <= MAX_STAGES; ++s) {
    const double dt = largest_step(s);
    if (s / dt < rate) {
      rate = s / dt;
      best = dt;
    }
  }
  return best;
}

AlloyBlock Solidification::block_arrays(int b) const {
  AlloyBlock k;
  k.psi = mesh_->cells(psi_, b);
  k.c = mesh_->cells(c_, b);
  k.psi_next = mesh_->cells(psi_other_, b);
  k.c_next = mesh_->cells(c_other_, b);
  k.dx = mesh_->block(b).dx;
  for (int a = 0; a < DIM; ++a) {
    k.first_cell[a] = std::int64_t{mesh_->block(b).index.coord[a]} * mesh_->layout().n;
    if (mesh_->shape().periodic()[a])
      k.period[a] = (std::int64_t{mesh_->shape().root_blocks[a]} << mesh_->block(b).index.level) * mesh_->layout().n;
    if (velocity_.id >= 0) k.velocity[static_cast<std::size_t>(a)] = mesh_->faces(velocity_, a, b);
  }
  return k;
}

// One stage of eqs. (1) and (2) on every block, and the fluxes of (2) made equal where levels meet.
void Solidification::run_stage(const Stage& stage, double noise, std::uint64_t noise_key, bool measure) {
  const amr::Layout& layout = mesh_->layout();
  if (measure) block_cost_.resize(static_cast<std::size_t>(mesh_->size()));
  ghosts_->fill_and_run({psi_, c_}, [&](int b) {
    const double begin = measure ? omp_get_wtime() : 0;
    AlloyBlock k = block_arrays(b);
    for (int f = 0; f < FACES; ++f) k.face_flux[static_cast<std::size_t>(f)] = fluxes_->store(b, f);
    if (b + 1 < mesh_->size()) k.ahead = {mesh_->cells(psi_, b + 1), mesh_->cells(c_, b + 1)};
    k.noise = noise;
    k.noise_key = noise_key + static_cast<std::uint64_t>(mesh_->block(b).index.level);
    AlloyParameters own = parameters_;
    local_axes_.apply(b, k, own);
    BlockKind kind = classify(k.psi, layout.n);
    if (kind == BlockKind::solid && local_axes_.disordered(b)) kind = BlockKind::interface;
    advance_alloy(k, kind, own, stage, layout.n);
    if (measure) block_cost_[static_cast<std::size_t>(b)] = {omp_get_wtime() - begin, static_cast<double>(kind)};
  });
  // What the fine side of a face lets through is what the coarse side receives.
  fluxes_->correct(c_other_, stage.weight);
  mesh_->swap(psi_, psi_other_);
  mesh_->swap(c_, c_other_);
}

void Solidification::advance(double, double dt, std::int64_t step) {
  if (phase_.rigid) {  // where they are at the end of the step
    std::vector<Seed> moved = crystals_;
    for (Seed& s : moved) s.advance(dt);
    draw(moved);
  }
  if (phase_.frozen) return;
  if (dt > largest_step(MAX_STAGES) * (1 + 1e-6))  // a fault elsewhere; the result would be wrong by percents before it is not finite
    throw NumericalError(fmt::format("a step of {:.4g} tau0, where {:.4g} tau0 is stable", dt, largest_step(MAX_STAGES)));
  turn_axes();
  local_axes_.update(crystals_);
  const double dx = mesh_->shape().dx(mesh_->shape().max_level);
  const int s = stages(dt);
  const double w = 2.0 / (s * s + s) * dt;
  double noise = 0;
  std::uint64_t key = 0;
  if (phase_.noise > 0) {
    noise = phase_.noise / std::sqrt(dt * std::pow(dx, DIM));
    key = (static_cast<std::uint64_t>(phase_.noise_seed) << 40) + (static_cast<std::uint64_t>(step) << 6);
  }
  fluxes_->prepare();
  run_stage({0, w}, noise, key, true);
  for (int j = 2; j <= s; ++j)
    run_stage({(1.0 - j) / j, (2.0 * j - 1) / j * w}, noise, key, false);
}

void Solidification::before_tagging() {
  // Mean time of a stage by kind of block, over all ranks, so that everybody weighs blocks alike.
  std::array<double, 6> sums{};
  for (const auto& [seconds, kind] : block_cost_) {
    sums[static_cast<std::size_t>(kind)] += seconds;
    sums[static_cast<std::size_t>(kind) + 3] += 1;
  }
  MPI_Allreduce(MPI_IN_PLACE, sums.data(), 6, MPI_DOUBLE, MPI_SUM, mesh_->comm());
  for (std::size_t i = 0; i < 3; ++i)
    if (sums[i] > 0) kind_cost_[i] = sums[i] / sums[i + 3];
}

void Solidification::tag(int b, amr::Tag& tag) const {
  tag_interface(*mesh_, psi_, phase_, b, tag);
  tag_solute(*mesh_, psi_, c_, scales_, solute_, b, tag);
  if (initializing_) tag_seeds(*mesh_, crystals_, phase_.band(), b, tag);
  tag.weight = kind_cost_[static_cast<std::size_t>(classify(mesh_->cells(psi_, b), mesh_->layout().n))];
}

double Solidification::front_speed() {
  if (phase_.rigid) {
    double fastest = 0;
    for (const Seed& s : crystals_) {
      const auto [along, across] = s.semi_axes();
      double speed = std::hypot(s.spin[0], s.spin[1], s.spin[2]) * std::max(along, across), square = 0;
      for (const double v : s.velocity) square += v * v;
      fastest = std::max(fastest, speed + std::sqrt(square));
    }
    return fastest;
  }
  if (phase_.frozen) return 0;
  const int n = mesh_->layout().n;
  const double band = phase_.band();
  std::vector<double> fastest(static_cast<std::size_t>(mesh_->size()), 0.0);
  local_axes_.update(crystals_);
  amr::parallel_for(mesh_->size(), [&](int b) {
    AlloyBlock k = block_arrays(b);
    AlloyParameters own = parameters_;
    local_axes_.apply(b, k, own);
    if (classify(k.psi, n) != BlockKind::interface) return;
    thread_local std::vector<double> rate;
    rate.resize(static_cast<std::size_t>(volume(filled(n))));
    psi_rate(k, own, n, rate);
    const double* r = rate.data();
    double& v = fastest[static_cast<std::size_t>(b)];
    amr::for_each_cell({}, filled(n), [&](const IntVec& c) {
      if (std::abs(k.psi[mesh_->layout().offset(c)]) < band) v = std::max(v, std::abs(*r));
      ++r;
    });
  });
  fastest_ = amr::global_max(fastest.empty() ? 0 : *std::max_element(fastest.begin(), fastest.end()), mesh_->comm());
  return fastest_;
}

}  // namespace dendrift::physics

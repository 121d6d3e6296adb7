#include "physics/orientation.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "amr/transfer.hpp"
#include "physics/alloy_kernel.hpp"
#include "physics/local_axes.hpp"

namespace dendrift::physics {

namespace {

constexpr double TAU_ALPHA = 0.1, MU_OVER_E = 1875, BETA = 1e5;  // of eq. (4); mu = 1e3
constexpr double LIQUID = -3.7429;  // psi of phi = -.99: below it alpha means nothing and is copied
constexpr double CORE = 2.0821;     // psi of phi = .9: above it the melt's shear is not felt
constexpr double COURANT = 0.6;
constexpr double SLOW = 1e-3;  // of a cell in a step: one stage is as good as three
constexpr int LAYERS_AT_REST = 2, LAYERS_MOVING = 4;

std::size_t at(int i) { return static_cast<std::size_t>(i); }

double difference(double to, double from) { return amr::wrapped(to - from, RIGHT_ANGLE); }

// What is added to the value of the upwind cell to get that at the face: third order, and no new extremes (Koren).
double limited_part(double behind, double ahead) {
  const double s = behind < 0 ? -1.0 : 1.0;
  return 0.5 * s * std::max(0.0, std::min({2.0 * s * ahead, s * (behind + 2.0 * ahead) / 3.0, 2.0 * s * behind}));
}

}  // namespace

void OrientationOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("orientation", "angles of crystals that touch, eq. (4); on by itself where crystals have "
                                             "several orientations");
  t.choice("P", p, {{"constant", Mobility::constant}, {"warren", Mobility::warren}, {"printed", Mobility::printed}})
      .doc("inverse mobility of the angle: mu/e everywhere; 1-(1-mu/e) exp(-beta w), with which boundaries sweep whole "
           "grains");
  t.real("max_dt_tau0", max_dt_tau0)
      .unit("tau0")
      .above(0)
      .at_most(10)
      .doc("time between two solutions of eq. (4); with warren .1 to .25 are advisable");
  t.real("tolerance", tolerance).range(1e-12, 0.1).doc("residual of a solution over the change it is to bring");
  t.boolean("everywhere", everywhere).doc("eq. (4) in all crystals; otherwise one that touches no other has one exact angle");
  schema.check({"orientation"}, [this](io::Checks& checks) {
    if (p == Mobility::printed)
      checks.fail("orientation.P", "constant or warren: the printed P = 1-(1+mu/e) exp(-beta w) is negative where the "
                                   "orientation is uniform, so that disturbances grow the faster the shorter they are",
                  "printed");
  });
}

double inverse_mobility(Mobility law, double w) {
  switch (law) {
    case Mobility::constant: return MU_OVER_E;
    case Mobility::warren: return 1 - (1 - MU_OVER_E) * std::exp(-BETA * w);
    case Mobility::printed: return 1 - (1 + MU_OVER_E) * std::exp(-BETA * w);
  }
  return MU_OVER_E;
}

Orientation::Orientation(const OrientationOptions& options, std::vector<Seed>& crystals)
    : options_(options), crystals_(crystals) {}

void Orientation::declare(amr::FieldTable& fields) {
  if constexpr (DIM == 3) return;
  amr::FieldSpec alpha;
  alpha.name = "alpha";
  alpha.symbol = "alpha";
  alpha.unit = "rad";
  alpha.doc = "angle of crystal axis 0, counterclockwise from x";
  alpha.transfer = amr::Transfer::conservative;
  alpha.mixing = amr::Mixing::angles;
  alpha.period = RIGHT_ANGLE;
  alpha.checkpoint = true;
  alpha_ = fields.add_cell(alpha);
  amr::FieldSpec scratch = alpha;
  scratch.transfer = amr::Transfer::none;
  scratch.checkpoint = false;
  scratch.doc = "alpha within a step; scratch";
  scratch.name = "alpha_first";
  first_ = fields.add_cell(scratch);
  scratch.name = "alpha_second";
  second_ = fields.add_cell(scratch);
  scratch.name = "alpha_valid";
  scratch.doc = "1 where alpha has been set; scratch";
  scratch.mixing = amr::Mixing::labels;
  valid_ = fields.add_cell(scratch);
}

void Orientation::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  psi_.id = mesh.fields().find("psi").value();
  grain_.id = mesh.fields().find("grain").value();
  v_.id = mesh.fields().find("velocity_x").value_or(-1);
}

void Orientation::initialize() {
  if constexpr (DIM == 2) impose(crystals_, true);
  present_ = static_cast<int>(std::ranges::count_if(crystals_, &Seed::present));
}

// A crystal that has just appeared has its own angle, not that of the melt that was there.
void Orientation::welcome() {
  const int present = static_cast<int>(std::ranges::count_if(crystals_, &Seed::present));
  if (present == present_) return;
  present_ = present;
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double* grain = mesh_->cells(grain_, b);
    double* alpha = mesh_->cells(alpha_, b);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      const Seed& crystal = crystals_[static_cast<std::size_t>(grain[q])];
      if (!crystal.touching) alpha[q] = crystal.angle;
    });
  });
}

// What the field has turned beyond the rigid motion counts as the crystal's turn.
void Orientation::follow(const std::vector<Seed>& moved) {
  const amr::Layout& layout = mesh_->layout();
  std::vector<std::vector<double>> parts(at(mesh_->size()));  // of each crystal: volume; times what the angle is beyond
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b), *alpha = mesh_->cells(alpha_, b);
    const double cell_volume = std::pow(mesh_->block(b).dx, DIM);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      if (psi[q] <= CORE || !free_cell(grain[q])) return;
      const auto g = static_cast<std::size_t>(grain[q]);
      parts[at(b)].resize(2 * crystals_.size());
      parts[at(b)][2 * g] += cell_volume;
      parts[at(b)][2 * g + 1] += cell_volume * difference(alpha[q], moved[g].angle);
    });
  });
  const std::vector<double> total = amr::exact_sums(parts, 2 * crystals_.size(), mesh_->comm());
  for (std::size_t g = 0; g < crystals_.size(); ++g)
    if (total[2 * g] > 0) crystals_[g].turn(total[2 * g + 1] / total[2 * g]);
}

// The angle of its grain wherever eq. (4) has nothing to say, or in all cells.
void Orientation::impose(const std::vector<Seed>& crystals, bool all) {
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
    double* alpha = mesh_->cells(alpha_, b);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      const Seed& crystal = crystals[static_cast<std::size_t>(grain[q])];
      if (all || !free(crystal) || psi[q] <= LIQUID) alpha[q] = crystal.angle;
    });
  });
}

void Orientation::advance(double, double dt, std::int64_t) {
  if constexpr (DIM == 3) return;
  welcome();
  std::vector<Seed> moved = crystals_;  // where they are at the end of the step
  for (Seed& s : moved) s.advance(dt);
  if (std::none_of(moved.begin(), moved.end(), [&](const Seed& s) { return free(s); })) {
    elapsed_ = 0;
    impose(moved, true);
    return;
  }
  find_busy();
  const double crossing = fastest_crossing();
  if (crossing > 0) {
    const int steps = std::max(1, static_cast<int>(std::ceil(dt * crossing / COURANT - 1e-9)));
    for (int i = 0; i < steps; ++i) carry(dt / steps, dt * crossing < SLOW);
    turn(dt);
  }
  impose(moved, false);
  elapsed_ += dt;
  if (elapsed_ + 0.5 * dt >= options_.max_dt_tau0) {
    relax(elapsed_);
    elapsed_ = 0;
    follow(moved);
  }
  extend(alpha_, LIQUID, crossing > 0 ? LAYERS_MOVING : LAYERS_AT_REST, true);
}

// Where all is melt, far from any front, angles mean nothing; where no crystal is free, they are imposed.
void Orientation::find_busy() {
  const amr::Layout& layout = mesh_->layout();
  busy_.assign(static_cast<std::size_t>(mesh_->size()), 0);
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
    char& busy = busy_[at(b)];
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      if (busy == 0 && psi[q] > -PSI_MAX && free_cell(grain[q])) busy = 1;
    });
  });
}

// Cells a unit of time, where angles mean something.
double Orientation::fastest_crossing() const {
  if (v_.id < 0) return 0;
  const amr::Layout& layout = mesh_->layout();
  double rate = 0;
  for (int b = 0; b < mesh_->size(); ++b)
    if (busy_[at(b)] != 0) amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      if (mesh_->cells(psi_, b)[layout.offset(cell)] <= LIQUID) return;
      double sum = 0;
      for (int a = 0; a < DIM; ++a) sum += std::abs(mesh_->faces(v_, a, b)[layout.offset(cell)]);
      rate = std::max(rate, sum / mesh_->block(b).dx);
    });
  return amr::global_max(rate, mesh_->comm());
}

// v.grad alpha of eq. (4), by the three-stage Runge-Kutta method that makes no new extremes (Shu & Osher 1988), or its first
// stage alone where all is so slow that its error in time is far below that of the differences: in a heap at rest.
void Orientation::carry(double dt, bool slow) {
  carry_stage(alpha_, first_, 0, dt);
  if (slow) {
    mesh_->swap(alpha_, first_);
    return;
  }
  carry_stage(first_, second_, 0.75, dt);
  carry_stage(second_, first_, 1.0 / 3, dt);
  mesh_->swap(alpha_, first_);
}

// to = share * alpha + (1 - share) * (from - dt v.grad from), as changes from alpha.
void Orientation::carry_stage(amr::CellField from, amr::CellField to, double share, double dt) {
  const amr::Layout& layout = mesh_->layout();
  const auto carry_block = [&](int b) {
    const double *x = mesh_->cells(from, b), *start = mesh_->cells(alpha_, b);
    double* out = mesh_->cells(to, b);
    const double over = dt / mesh_->block(b).dx;
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      double change = 0;
      for (int a = 0; a < DIM; ++a) {
        const std::ptrdiff_t s = layout.stride(a);
        const double *v = mesh_->faces(v_, a, b) + q, lo = v[0], hi = v[s];
        const double below = difference(x[q], x[q - s]), above = difference(x[q + s], x[q]);
        // Values at the faces less that of the cell.
        const double at_high = hi > 0 ? limited_part(below, above)
                                      : above + limited_part(difference(x[q + s], x[q + 2 * s]), -above);
        const double at_low = lo < 0 ? limited_part(-above, -below)
                                     : -below + limited_part(difference(x[q - s], x[q - 2 * s]), below);
        change += hi * at_high - lo * at_low;
      }
      out[q] = start[q] + (1 - share) * ((x[q] - start[q]) - over * change);
    });
  };
  ghosts_->fill_and_run({from}, carry_block, &busy_);
  amr::parallel_for(mesh_->size(), [&](int b) {
    if (busy_[at(b)] != 0) return;
    const double* stays = mesh_->cells(alpha_, b) - layout.interior();
    std::copy_n(stays, layout.size(), mesh_->cells(to, b) - layout.interior());
  });
}

// omega_z/2 of eq. (4): the vorticity of the solid, where the melt does not shear it, carried on through the interface.
void Orientation::turn(double dt) {
  const amr::Layout& layout = mesh_->layout();
  const amr::CellField vorticity = second_;
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
    const double *u = mesh_->faces(v_, 0, b), *v = mesh_->faces(v_, 1, b);
    double* w = mesh_->cells(vorticity, b);
    const double over = 0.25 / mesh_->block(b).dx;
    const std::ptrdiff_t y = layout.stride(1);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      // Mean over the corners of the cell.
      const double dv = (v[q + 1] - v[q - 1]) + (v[q + y + 1] - v[q + y - 1]);
      const double du = (u[q + y] - u[q - y]) + (u[q + y + 1] - u[q - y + 1]);
      w[q] = psi[q] > CORE ? over * (dv - du) : 2 * crystals_[static_cast<std::size_t>(grain[q])].spin[2];
    });
  });
  const double interface = CORE - LIQUID;
  const double finest = mesh_->shape().dx(mesh_->shape().max_level);
  extend(vorticity, CORE, static_cast<int>(std::ceil(interface / finest)) + 2, false);
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double* w = mesh_->cells(vorticity, b);
    double* alpha = mesh_->cells(alpha_, b);
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      alpha[q] += 0.5 * dt * w[q];
    });
  });
}

// Cells below `least` copy the value of that neighbour with a value which has the largest psi, layer by layer. Two
// layers of ghosts allow two layers at a time.
void Orientation::extend(amr::CellField values, double least, int layers, bool free_only) {
  const amr::Layout& layout = mesh_->layout();
  const int n = layout.n;
  std::array<std::ptrdiff_t, DIRECTIONS> around{};
  for (int d = 0; d < DIRECTIONS; ++d)
    for (int a = 0; a < DIM; ++a) around[at(d)] += direction_offset(d)[a] * layout.stride(a);
  for (int done = 0; done < layers; done += amr::Layout::GHOSTS) {
    const auto fields = done == 0 ? std::vector{psi_, grain_, values} : std::vector{values, valid_};
    ghosts_->fill_and_run(fields, [](int) {}, &busy_);
    amr::parallel_for(mesh_->size(), [&](int b) {
      const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
      double *value = mesh_->cells(values, b), *kept = mesh_->cells(valid_, b);
      if (busy_[at(b)] == 0) {  // it may be copied from
        if (done == 0)
          for (std::ptrdiff_t q = -layout.interior(); q < layout.size() - layout.interior(); ++q) kept[q] = psi[q] > least ? 1 : 0;
        return;
      }
      thread_local std::vector<char> flags;
      flags.resize(static_cast<std::size_t>(layout.size()));
      char* valid = flags.data() + layout.interior();
      bool some = false, all = true;
      for (std::ptrdiff_t q = -layout.interior(); q < layout.size() - layout.interior(); ++q) {
        valid[q] = static_cast<char>(done == 0 ? psi[q] > least : kept[q] > 0);
        some = some || valid[q] != 0;
        all = all && valid[q] != 0;
      }
      for (int layer = 0; layer < amr::Layout::GHOSTS && some && !all; ++layer) {
        const int rim = 1 - layer;
        amr::for_each_cell(filled(-rim), filled(n + 2 * rim), [&](const IntVec& cell) {
          const std::ptrdiff_t q = layout.offset(cell);
          if (valid[q] != 0 || (free_only && !free_cell(grain[q]))) return;
          double most = -2 * PSI_MAX;
          for (const std::ptrdiff_t way : around) {
            const std::ptrdiff_t p = q + way;
            if (valid[p] != 1 || psi[p] <= most) continue;
            most = psi[p];
            value[q] = value[p];
          }
          if (most >= -PSI_MAX) valid[q] = 2;  // from the next layer on
        });
        for (std::ptrdiff_t q = -layout.interior(); q < layout.size() - layout.interior(); ++q)
          valid[q] = static_cast<char>(valid[q] != 0);
      }
      amr::for_each_cell({}, filled(n), [&](const IntVec& cell) {
        kept[layout.offset(cell)] = valid[layout.offset(cell)];
      });
    });
  }
}

// The right side of eq. (4), backward Euler over dt.
void Orientation::relax(double dt) {
  if (solver_ == nullptr || solver_generation_ != mesh_->generation()) {
    amr::ScalarOptions o;
    o.tolerance = options_.tolerance;
    o.directions = 20;  // diffusivities differ by a factor of up to 1e6
    o.max_iterations = 200;
    solver_ = std::make_unique<amr::ScalarSolver>(*mesh_, std::array<amr::MirrorRule, FACES>{}, o);
    solver_generation_ = mesh_->generation();
  }
  iterations_ = 0;
  constexpr double LARGE = 0.01;  // rad: coefficients from before are too far off
  if (sweep(dt, true) > LARGE) sweep(dt, false);
}

// Largest change of alpha. `first`: alpha is that of the beginning, which is kept in first_.
double Orientation::sweep(double dt, bool first) {
  const amr::Layout& layout = mesh_->layout();
  ghosts_->fill({psi_, grain_, alpha_});
  std::vector<double> most(at(mesh_->size()), 0.0);
  amr::parallel_for(mesh_->size(), [&](int b) { most[at(b)] = set_system(b, dt, first); });
  const auto largest = [&] {
    return amr::global_max(most.empty() ? 0.0 : *std::max_element(most.begin(), most.end()), mesh_->comm());
  };
  const double force = largest();
  constexpr double NOTHING = 1e-13;  // rad
  if (force * dt / TAU_ALPHA < NOTHING) return 0;
  if (options_.p == Mobility::constant) {
    solver_->prepare(inverse_mobility(options_.p, 0) * TAU_ALPHA / dt);
  } else {
    solver_->prepare_with_extra(TAU_ALPHA / dt);
  }
  const amr::ScalarResult result = solver_->solve();
  iterations_ += result.iterations;
  if (!result.converged)
    throw NumericalError(fmt::format("eq. (4) is not solved after {} iterations: residual {:.3g}, tolerance {:.3g}; a "
                                     "smaller orientation.max_dt_tau0 may help",
                                     result.iterations, result.residual, options_.tolerance));
  amr::parallel_for(mesh_->size(), [&](int b) {
    const auto [g, i] = solver_->hierarchy().place_of_block(b);
    const double *change = solver_->solution().at(g, i, 0), *psi = mesh_->cells(psi_, b);
    const double* grain = mesh_->cells(grain_, b);
    double *alpha = mesh_->cells(alpha_, b), largest_here = 0;
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      if (psi[q] <= LIQUID || !free_cell(grain[q])) return;
      alpha[q] += change[q];
      largest_here = std::max(largest_here, std::abs(change[q]));
    });
    most[at(b)] = largest_here;
  });
  return largest();
}

// P tau_alpha (alpha_new - alpha_old)/dt = div[(g s/|grad alpha| + h e^2) grad alpha_new] of block b for the unknown
// alpha_new - alpha, which begins from 0. Returns the largest right-hand side.
double Orientation::set_system(int b, double dt, bool first) {
  const amr::Layout& layout = mesh_->layout();
  const auto [g, i] = solver_->hierarchy().place_of_block(b);
  const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b), *alpha = mesh_->cells(alpha_, b);
  const double dx = mesh_->block(b).dx, gamma = options_.p == Mobility::constant ? Disorder::gamma : 1e-6;
  constexpr double e2 = Disorder::e * Disorder::e;
  thread_local std::vector<double> squares_array;  // |grad alpha|^2, sum over the faces of a cell
  squares_array.assign(static_cast<std::size_t>(layout.size()), 0.0);
  double *squares = squares_array.data() + layout.interior(), *rhs = solver_->rhs().at(g, i, 0);
  double *x = solver_->solution().at(g, i, 0), *extra = solver_->extra().at(g, i, 0);
  amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
    std::fill_n(rhs + layout.offset(row), layout.n, 0.0);
    std::fill_n(x + layout.offset(row), layout.n, 0.0);
  });
  const auto solid = [&](std::ptrdiff_t q) { return psi[q] > LIQUID && free_cell(grain[q]); };
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = layout.stride(a);
    double* beta = solver_->beta().at(g, i, a);
    IntVec size = filled(layout.n);
    ++size[a];
    amr::for_each_cell({}, size, [&](const IntVec& face) {
      const std::ptrdiff_t q = layout.offset(face);  // the face below q
      constexpr double NO_FLUX = 1e-12;
      beta[q] = NO_FLUX;
      if (!solid(q) || !solid(q - s)) return;
      const double normal = difference(alpha[q], alpha[q - s]) / dx;
      double square = normal * normal;
      for (int c = 0; c < DIM; ++c) {
        if (c == a) continue;
        const std::ptrdiff_t t = layout.stride(c);
        const double along = (difference(alpha[q], alpha[q - t]) + difference(alpha[q + t], alpha[q]) +
                              difference(alpha[q - s], alpha[q - s - t]) + difference(alpha[q - s + t], alpha[q - s])) /
                             (4 * dx);
        square += along * along;
      }
      const double f = 0.5 * (1 + phi_of_psi(0.5 * (psi[q] + psi[q - s])));
      beta[q] = f * f * (Disorder::s / std::sqrt(square + gamma * gamma) + e2);
      const double flux = beta[q] * normal / dx;
      squares[q] += square;
      squares[q - s] += square;
      rhs[q] -= flux;       // ghosts take what nobody reads
      rhs[q - s] += flux;
    });
  }
  double most = 0;
  const double *old = first ? nullptr : mesh_->cells(first_, b);
  double* keep = mesh_->cells(first_, b);
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
    const std::ptrdiff_t q = layout.offset(cell);
    const double p = inverse_mobility(options_.p, Disorder::e * std::sqrt(squares[q] / FACES));
    extra[q] = (p - 1) * TAU_ALPHA / dt;
    if (first) {
      keep[q] = alpha[q];
    } else {
      rhs[q] -= p * TAU_ALPHA / dt * (alpha[q] - old[q]);
    }
    if (!solid(q)) rhs[q] = 0;
    most = std::max(most, std::abs(rhs[q]));
  });
  return most;
}

void Orientation::before_tagging() {
  if (alpha_.id >= 0) ghosts_->fill({alpha_});
}

// Boundaries between grains stay on the finest level.
void Orientation::tag(int b, amr::Tag& tag) const {
  if (DIM == 3) return;
  constexpr double JUMP = 0.01;  // rad, between neighbouring cells
  const amr::Layout& layout = mesh_->layout();
  const double *psi = mesh_->cells(psi_, b), *alpha = mesh_->cells(alpha_, b);
  bool found = false;
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = layout.stride(a);
    amr::for_each_cell(filled(-1), filled(layout.n + 1), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      const bool solid = psi[q] > LIQUID && psi[q + s] > LIQUID;
      if (solid && std::abs(difference(alpha[q + s], alpha[q])) > JUMP) found = true;
    });
  }
  if (found) tag.level = tag.keep = mesh_->shape().max_level;
}

}  // namespace dendrift::physics

#include "simulation.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <csignal>
#include <filesystem>
#include <limits>

#include "amr/comm.hpp"
#include "io/hdf5.hpp"
#include "io/plotfile.hpp"
#include "memory.hpp"
#include "output.hpp"
#include "physics/alloy_kernel.hpp"
#include "physics/modules.hpp"
#include "physics/motion.hpp"
#include "restart.hpp"

namespace dendrift {

namespace {

volatile std::sig_atomic_t stop_requested = 0;

constexpr double DIAGNOSTICS_TOLERANCE = 1e-9;  // of a time, relative: reached

constexpr const char* GIVEN_UP = ".old";  // follows the name of a checkpoint that is later than a restart

std::size_t at(int i) { return static_cast<std::size_t>(i); }

// The first multiple of an interval that lies after t.
std::int64_t next_multiple(double t, double interval) {
  if (interval <= 0) return 1;
  return static_cast<std::int64_t>(std::min(t / interval * (1 + DIAGNOSTICS_TOLERANCE), 1e15)) + 1;
}

// Neumaier's sum: thousands of nearly equal terms would otherwise round the same way and look like lost solute.
class Compensated {
 public:
  void add(double x) {
    const double t = sum_ + x;
    rest_ += std::abs(sum_) >= std::abs(x) ? (sum_ - t) + x : (x - t) + sum_;
    sum_ = t;
  }
  double value() const { return sum_ + rest_; }

 private:
  double sum_ = 0, rest_ = 0;
};

}  // namespace

void Simulation::request_stop() { stop_requested = 1; }

Simulation::Simulation(Settings& settings, MPI_Comm comm, const std::optional<std::string>& checkpoint, bool allow_changes)
    : settings_(settings), comm_(comm), crystals_(settings.crystals), caution_(settings.guard.max_retries) {
  wall_start_ = last_save_ = MPI_Wtime();
  started_ = io::time_stamp();
  modules_ = physics::make_modules(settings, crystals_);
  amr::FieldTable fields;
  for (const auto& m : modules_) m->declare(fields);
  require_memory(volume(settings.shape.root_blocks), fields);
  mesh_ = std::make_unique<amr::Mesh>(settings.shape, fields, comm);
  ghosts_ = std::make_unique<amr::GhostExchange>(*mesh_);
  psi_ = field("psi");
  c_ = field("c");
  for (const auto& m : modules_) m->attach(*mesh_, *ghosts_);
  if (checkpoint) {
    resume(*checkpoint, allow_changes);
  } else {
    build_initial_mesh();
    initial_solute_ = totals().solute_mean;
  }
  first_time_ = time_;
}

Simulation::~Simulation() = default;

void Simulation::build_initial_mesh() {
  for (int pass = 0; pass <= 2 * settings_.shape.max_level + 1; ++pass) {
    for (const auto& m : modules_) m->initialize();
    if (!adapt(pass == 0 ? 1.0 : settings_.parallel.max_imbalance)) break;
  }
  for (const auto& m : modules_) m->initialize();
  adapt(1.0);  // spread the final mesh by the partitioner of choice
  for (const auto& m : modules_) m->after_regrid();
  schedule_regrid();
  starting_ = false;
}

void Simulation::require_memory(std::int64_t blocks, const amr::FieldTable& fields) const {
  const Memory m = memory_of_mesh(blocks, fields, amr::Layout{settings_.shape.block_cells}, comm_);
  if (m.enough()) return;
  const std::string key = settings_.mesh.root_blocks ? "mesh.root_blocks"
                          : settings_.mesh.size_w0   ? "mesh.size_W0"
                                                     : "mesh.size_um";
  throw settings_.schema.error(
      key, fmt::format("a mesh that fits into the memory of a node, {:.3g} GB", 1e-9 * m.present),
      fmt::format("{} blocks of {} cells a side at the start, that need {:.3g} GB on a node", blocks,
                  settings_.shape.block_cells, 1e-9 * m.needed));
}

void Simulation::resume(const std::string& file, bool allow_changes) {
  const io::RunState s = io::read_state(file, comm_);
  require_same_scene(settings_, file, s, allow_changes);
  require_later_end(file, s);
  if (const auto missing = io::missing_fields(file, *mesh_); !missing.empty())
    throw io::OutputError(file, "restart",
                          fmt::format("it does not hold what the input asks for: field {}", fmt::join(missing, ", ")));
  amr::Tree tree = mesh_->tree();
  try {
    tree = amr::Tree(settings_.shape.root_blocks, settings_.shape.periodic(), settings_.shape.max_level,
                     io::read_leaves(file, comm_));
  } catch (const std::invalid_argument& e) {
    throw io::OutputError(file, "restart", e.what());
  }
  require_memory(tree.size(), mesh_->fields());
  const std::vector<double> weights(at(tree.size()), 1.0);
  std::vector<int> owners = amr::partition(settings_.parallel.partitioner, tree, weights, mesh_->ranks());
  for (const amr::Block& b : mesh_->blocks()) mesh_->release_slot(b.slot);
  const std::vector<int> fresh(at(tree.size()), -1);
  mesh_->install(std::move(tree), std::move(owners), fresh);
  io::read_fields(file, *mesh_);
  try {
    recall(file, s);
  } catch (const std::out_of_range& e) {  // a list is shorter or longer than what it is for
    throw io::OutputError(file, "restart", fmt::format("what it remembers does not fit the input: {}", e.what()));
  }
  first_step_ = step_;
  resumed_ = true;
  starting_ = false;
  for (const auto& m : modules_) m->after_regrid();
  if (mesh_->rank() == 0) fmt::print("{}", restart_log(settings_, file, s, origin()));
}

void Simulation::recall(const std::string& file, const io::RunState& s) {
  const auto list = [&](const char* name) -> const std::vector<double>& {
    const auto found = s.numbers.find(name);
    if (found == s.numbers.end()) throw io::OutputError(file, "restart", std::string("it does not hold ") + name);
    return found->second;
  };
  time_ = s.time;
  step_ = s.step;
  const auto take = [&](const char* name) { return list(name).at(0); };
  const auto count = [&](const char* name) {
    const double x = take(name);
    if (std::abs(x) < 1e15) return static_cast<std::int64_t>(x);
    throw io::OutputError(file, "restart", fmt::format("the file is damaged: {} is {}", name, x));
  };
  next_regrid_ = count("next_regrid");
  // Counted anew, because a restart may have other intervals.
  plots_ = next_multiple(time_, settings_.plot_interval);
  lines_ = next_multiple(time_, settings_.diagnostics_interval);
  checkpoints_ = next_multiple(time_, settings_.output.checkpoint_every_s / settings_.scales.tau0_s) - 1;
  last_line_step_ = count("last_line_step");
  initial_solute_ = take("initial_solute");
  const std::vector<double>& positions = list("crystals");
  const std::size_t each = positions.size() / std::max<std::size_t>(1, crystals_.size());
  for (std::size_t g = 0; g < crystals_.size(); ++g) physics::recall(crystals_[g], std::span(positions).subspan(g * each, each));
  for (const auto& [name, values] : s.numbers)
    if (name.starts_with("tip.")) last_tips_[name.substr(4)] = values;
  for (const auto& m : modules_)
    if (const auto memory = s.numbers.find(std::string("module.") + m->name()); memory != s.numbers.end()) m->recall(memory->second);
}

std::string Simulation::origin() const {
  const std::string version = io::version_text();
  return fmt::format("ranks {}, threads {}, {}", mesh_->ranks(), omp_get_max_threads(), version.substr(0, version.find('\n')));
}

void Simulation::require_later_end(const std::string& file, const io::RunState& s) const {
  const double unit = settings_.run.end_time_s ? settings_.scales.tau0_s : 1;
  if (settings_.end_time < s.time * (1 - DIAGNOSTICS_TOLERANCE))
    throw settings_.schema.error(settings_.run.end_time_s ? "run.end_time_s" : "run.end_time_tau0",
                                 fmt::format("at least {:.6g}, the time of {}", s.time * unit, file),
                                 fmt::format("{:.6g}", settings_.end_time * unit));
  if (settings_.run.max_steps < s.step)
    throw settings_.schema.error("run.max_steps", fmt::format("at least {}, the step of {}", s.step, file));
}

io::RunState Simulation::state() const {
  io::RunState s;
  s.time = time_;
  s.step = step_;
  s.input = settings_.schema.resolved_toml();
  s.numbers["next_regrid"] = {static_cast<double>(next_regrid_)};
  s.origin = origin();
  s.numbers["shape"] = shape_numbers(settings_);
  if (const auto seeds = settings_.seeds_checksum()) s.numbers["seeds_file"] = {static_cast<double>(*seeds)};
  s.numbers["last_line_step"] = {static_cast<double>(last_line_step_)};
  s.numbers["initial_solute"] = {initial_solute_};
  for (const physics::Seed& g : crystals_) {
    const std::vector<double> memory = physics::memory(g);
    s.numbers["crystals"].insert(s.numbers["crystals"].end(), memory.begin(), memory.end());
  }
  for (const auto& m : modules_) s.numbers[std::string("module.") + m->name()] = m->memory();
  for (const auto& [name, values] : last_tips_) s.numbers["tip." + name] = values;
  return s;
}

bool Simulation::adapt(double max_imbalance) {
  ghosts_->fill({psi_, c_});
  for (const auto& m : modules_) m->before_tagging();
  std::vector<amr::Tag> tags(at(mesh_->size()));
  amr::parallel_for(mesh_->size(), [&](int b) {
    for (const auto& m : modules_) m->tag(b, tags[at(b)]);
  });
  const amr::Proposal proposal = amr::propose(*mesh_, tags);
  if (starting_) require_memory(proposal.tree.size(), mesh_->fields());
  return amr::regrid(*mesh_, *ghosts_, proposal, {settings_.parallel.partitioner, max_imbalance});
}

void Simulation::schedule_regrid() {
  double speed = 0;
  ghosts_->fill({psi_, c_});
  for (const auto& m : modules_) speed += m->front_speed();
  // Half the buffer, so that the front may double its speed before the next look.
  const double way = 0.5 * (settings_.phase_field.buffer_cells - 1) * mesh_->shape().dx(mesh_->shape().max_level);
  const double steps = speed > 0 ? way / (speed * max_dt()) : settings_.mesh.max_regrid_steps;
  next_regrid_ = step_ + std::clamp(static_cast<std::int64_t>(std::min(steps, 1e6)), std::int64_t{1},
                                    std::int64_t{settings_.mesh.max_regrid_steps});
}

double Simulation::max_dt() const {
  double dt = 1e30;
  for (const auto& m : modules_) dt = std::min(dt, m->max_dt());
  return dt;
}

void Simulation::step(double dt) {
  for (const auto& m : modules_) clock_.time(m->name(), [&] { m->advance(time_, dt, step_); });
  for (physics::Seed& g : crystals_) g.advance(dt);
  time_ += dt;
  ++step_;
  if (step_ < next_regrid_) return;
  clock_.time("regrid", [&] {
    if (adapt(settings_.parallel.max_imbalance))
      for (const auto& m : modules_) m->after_regrid();
    schedule_regrid();
  });
}

double Simulation::next_stop() const {
  double t = settings_.end_time;
  t = std::min(t, static_cast<double>(lines_) * settings_.diagnostics_interval);
  if (settings_.plot_interval > 0) t = std::min(t, static_cast<double>(plots_) * settings_.plot_interval);
  return t;
}

Outcome Simulation::run() {
  try {
    open_output();
    while (true) {
      try {
        if (const auto outcome = iterate()) return *outcome;
      } catch (const NumericalError&) {
        go_back();
      }
    }
  } catch (const NumericalError& e) {
    throw NumericalError(leave_behind(e.what()));
  } catch (const io::OutputError& e) {
    record_failure(manifest("failed", clock_.seconds()), exit_code::output_failure, e.what());
    throw;
  }
}

// The bad state beside the good checkpoints, the last good one among them, and the manifest. Returns what to say.
std::string Simulation::leave_behind(std::string message) {
  const io::Manifest failed = manifest("failed", clock_.seconds());
  try {
    write_checkpoint(path(fmt::format("failed_{:07d}.h5", step_)));
    if (!snapshot_.empty()) {
      restore();
      save();
      message += fmt::format("\nthe last good state, of step {}, is in {}", step_, checkpoint_name());
    }
  } catch (const io::OutputError& not_saved) {
    message += fmt::format("; a state is lost: {}", not_saved.what());
  }
  record_failure(failed, exit_code::numerical_failure, message);
  return message;
}

std::optional<Outcome> Simulation::iterate() {
  const auto reached = [&](double t) { return time_ >= t * (1 - DIAGNOSTICS_TOLERANCE); };
  const auto due = [&](std::int64_t count, double interval) {
    return interval > 0 && reached(static_cast<double>(count) * interval);
  };
  const double checkpoint_interval = settings_.output.checkpoint_every_s / settings_.scales.tau0_s;
  const bool end = reached(settings_.end_time) || step_ >= settings_.run.max_steps;
  if (due(lines_, settings_.diagnostics_interval) || end) {
    clock_.time("diagnostics", [&] {
      const Totals t = totals();
      check_totals(t);
      if (step_ != last_line_step_) {
        io::SharedFailure failure;  // one rank writes; all must learn that it could not
        failure.attempt(path("diagnostics.csv"), "write a line", [&] { write_line(t, dt_); });
        write_tips(failure);
        write_grains(failure);
        failure.agree(comm_);
        last_line_step_ = step_;
        written_ = true;
      }
      lines_ = next_multiple(time_, settings_.diagnostics_interval);
      progress(t, dt_, end);
    });
  }
  if (due(plots_, settings_.plot_interval) || (plots_ == 0) || end) {
    clock_.time("plotfile", [&] { write_plotfile(); });
    plots_ = next_multiple(time_, settings_.plot_interval);
    written_ = true;
  }
  if (end) {
    write_manifest("done", exit_code::done);
    return Outcome::done;
  }
  const bool steps_due = settings_.output.checkpoint_every_steps > 0 && step_ > first_step_ &&
                         step_ % settings_.output.checkpoint_every_steps == 0;
  const Request request = agreed_request();
  if (due(checkpoints_ + 1, checkpoint_interval) || steps_due || request != Request::none) {
    checkpoints_ = next_multiple(time_, checkpoint_interval) - 1;
    clock_.time("checkpoint", [&] { save(); });
    written_ = true;
  }
  if (request == Request::stop) {
    write_manifest("stopped", exit_code::stopped);
    return Outcome::stopped;
  }
  clock_.time("guard", [&] { keep_snapshot(); });
  const double most = caution_.factor() * max_dt();
  if (!(most > settings_.guard.min_dt_tau0))
    throw NumericalError(fmt::format("the time step has collapsed to {:.3g} tau0 at step {}, t = {:.6g} tau0", most, step_, time_));
  const double stop = next_stop();
  const double pieces = std::max(1.0, std::ceil((stop - time_) / most - 1e-9));
  dt_ = (stop - time_) / pieces;
  if (before_step_) dt_ = before_step_(dt_);
  step(dt_);
  if (pieces == 1) time_ = stop;
  clock_.time("guard", [&] { check_state(); });
  caution_.settle(time_, step_);
  return std::nullopt;
}

// Never older than what has been written, so that nothing is written twice.
void Simulation::keep_snapshot() {
  const int every = settings_.guard.snapshot_every_steps;
  if (every == 0 || (!snapshot_.empty() && !written_ && step_ < snapshot_.state().step + every)) return;
  if (snapshot_.empty()) check_state();  // what a run starts from may be bad already
  snapshot_.take(*mesh_, state());
  written_ = false;
}

void Simulation::check_state() const {
  const std::string when = fmt::format("at step {}, t = {:.6g} tau0", step_, time_);
  if (const auto fault = find_fault(*mesh_, psi_, c_, settings_.guard.max_c, when)) throw NumericalError(*fault);
}

void Simulation::go_back() {
  try {
    throw;
  } catch (const NumericalError& e) {
    if (snapshot_.empty() || !caution_.may_retry(time_, step_)) throw;
    const std::int64_t failed = step_;
    restore();
    for (const auto& m : modules_) m->be_careful();
    if (mesh_->rank() == 0)
      fmt::print("step {} failed: {}\nback to step {}, with steps of at most {:.3g} of what is stable (try {} of {})\n", failed, e.what(),
                 step_, caution_.factor(), caution_.tries(), settings_.guard.max_retries);
  }
}

void Simulation::restore() {
  snapshot_.restore(*mesh_);
  crystals_ = settings_.crystals;  // in place: modules refer to them
  recall("memory", snapshot_.state());
  for (const auto& m : modules_) m->after_regrid();
}

Simulation::Request Simulation::agreed_request() const {
  const double now = MPI_Wtime(), limit = settings_.run.wall_clock_limit_s, every = settings_.output.checkpoint_every_wall_s;
  Request mine = Request::none;
  if (every > 0 && now - last_save_ > every) mine = Request::checkpoint;
  if (stop_requested != 0 || (limit > 0 && now - wall_start_ > limit)) mine = Request::stop;
  return static_cast<Request>(amr::global_max(static_cast<double>(mine), comm_));
}

void Simulation::print_check() {
  const physics::Scales& s = settings_.scales;
  const double dt = max_dt();
  const double dx = mesh_->shape().dx(mesh_->shape().max_level);
  const Totals t = totals();
  step(dt);
  const double begin = MPI_Wtime();
  step(dt);
  const double each = amr::global_max(MPI_Wtime() - begin, comm_);
  const auto bytes = static_cast<double>(mesh_->bytes());
  const double memory = amr::global_max(bytes, comm_) * mesh_->ranks();
  if (mesh_->rank() != 0) return;
  const double steps = std::min(settings_.end_time / dt, static_cast<double>(settings_.run.max_steps));
  fmt::print("input is valid\n");
  fmt::print("output dir: {}\n", settings_.output.dir);
  fmt::print("c_l     {:.6g} wt%\nd0      {:.6g} um\nW0      {:.6g} um\ntau0    {:.6g} s\nlambda  {:.6g}\n",
             s.c_l_wt, s.d0_um, s.w0_um, s.tau0_s, s.lambda);
  fmt::print("D       {:.6g} W0^2/tau0\nnu      {:.6g} W0^2/tau0\ndt      {:.4g} tau0 = {:.4g} s\n", s.diffusivity, s.viscosity, dt, dt * s.tau0_s);
  fmt::print("end     {:.6g} tau0 = {:.6g} s\n", settings_.end_time, settings_.end_time * s.tau0_s);
  fmt::print("box    ");
  for (int a = 0; a < DIM; ++a) fmt::print(" {:.6g}", mesh_->shape().hi()[a]);
  fmt::print(" W0, root blocks");
  for (const int r : mesh_->shape().root_blocks) fmt::print(" {}", r);
  fmt::print(", {} levels, blocks of {} cells a side\n", mesh_->shape().max_level + 1, mesh_->layout().n);
  fmt::print("dx      {:.6g} W0 = {:.6g} um on the finest level\n", dx, dx * s.w0_um);
  fmt::print("cells   {} in {} blocks at the start\n", t.blocks * volume(filled(mesh_->layout().n)), t.blocks);
  fmt::print("memory  {:.1f} MB in fields at the start\n", memory / 1e6);
  fmt::print("cost    {:.0f} steps, {:.3g} s each at the start: at least {:.3g} s on {} ranks\n", steps, each, steps * each,
             mesh_->ranks());
}

Totals Simulation::totals() {
  Totals t;
  std::array<amr::ExactSum, 2> sums;
  std::vector<std::array<double, 2>> parts(at(mesh_->size()));
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double* psi = mesh_->cells(psi_, b);
    const double* c = mesh_->cells(c_, b);
    double solid = 0;
    Compensated solute;
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      const std::ptrdiff_t q = layout.offset(cell);
      solid += 0.5 * (1 + physics::phi_of_psi(psi[q]));
      solute.add(c[q]);
    });
    const double volume = std::pow(mesh_->block(b).dx, DIM);
    parts[at(b)] = {solid * volume, solute.value() * volume};
  });
  bool finite = true;
  for (const auto& p : parts)
    for (std::size_t i = 0; i < 2; ++i) {
      finite = finite && std::isfinite(p[i]);
      if (finite) sums[i].add(p[i]);
    }
  const std::vector<double> all = amr::exact_sums(sums, comm_);
  double box = 1;
  for (int a = 0; a < DIM; ++a) box *= mesh_->shape().hi()[a] - mesh_->shape().lo[a];
  t.solid_fraction = all[0] / box;
  t.solute_mean = all[1] / box;
  if (amr::global_any(!finite, comm_)) t.solute_mean = std::numeric_limits<double>::quiet_NaN();
  t.blocks = mesh_->tree().size();
  t.levels = mesh_->tree().finest_level() + 1;
  return t;
}

std::vector<physics::Tip> Simulation::tips() {
  ghosts_->fill({psi_});
  return physics::find_tips(*mesh_, psi_, crystals_);
}

void Simulation::check_totals(const Totals& t) const {
  if (!std::isfinite(t.solute_mean))
    throw NumericalError(fmt::format("phi or c is not finite at step {}, t = {:.6g} tau0", step_, time_));
  const auto& sides = settings_.shape.sides;
  const bool open = std::ranges::find(sides, amr::Side::open) != sides.end() || settings_.flow.through_walls(settings_.shape);
  // Crystals that are drawn where they should be push no solute.
  if (!open && !settings_.phase_field.rigid && std::abs(solute_drift(t)) > settings_.guard.max_solute_drift)
    throw NumericalError(fmt::format("solute is not conserved at step {}, t = {:.6g} tau0: it has changed by {:.3g} of what there was",
                                     step_, time_, solute_drift(t)));
}

void Simulation::open_output() {
  const bool root = mesh_->rank() == 0;
  io::SharedFailure failure;
  if (root)
    failure.attempt(settings_.output.dir, "open the output", [&] {
      std::error_code error;
      std::filesystem::create_directories(settings_.output.dir, error);
      if (error) throw io::OutputError(settings_.output.dir, "create the folder", error.message());
      const std::string diagnostics =
          "step,time_s,time_tau0,dt_tau0,blocks,cells,levels,solid_fraction,solute_mean_wt,solute_drift_rel,"
          "max_speed_um_s,div_max_rel,flow_iterations,wall_s,flow_residual";
      const std::string tips = std::string("time_s,grain,arm,euler_deg,x_um,y_um,") + (DIM == 3 ? "z_um," : "") +
                               "speed_um_s,radius_um,off_axis_deg";
      const std::string grains =
          DIM == 2 ? "time_s,grain,x_um,y_um,vx_um_s,vy_um_s,omega_rad_s,angle_rad,area_um2,nonrigidity,contacts"
                   : "time_s,grain,x_um,y_um,z_um,vx_um_s,vy_um_s,vz_um_s,omega_x_rad_s,omega_y_rad_s,omega_z_rad_s,"
                     "q0,q1,q2,q3,volume_um3,nonrigidity,contacts";
      const double now = time_ * settings_.scales.tau0_s;
      if (resumed_) find_saved();
      remove_leftovers();
      if (resumed_) {
        io::cut_series(path("plt.hdf.series"), now);
        grains_csv_ = std::make_unique<io::CsvFile>(path("grains.csv"), grains, "time_s", now);
        diagnostics_csv_ = std::make_unique<io::CsvFile>(path("diagnostics.csv"), diagnostics, "time_s", now);
        tips_csv_ = std::make_unique<io::CsvFile>(path("tips.csv"), tips, "time_s", now);
      } else {
        diagnostics_csv_ = std::make_unique<io::CsvFile>(path("diagnostics.csv"), diagnostics);
        tips_csv_ = std::make_unique<io::CsvFile>(path("tips.csv"), tips);
        grains_csv_ = std::make_unique<io::CsvFile>(path("grains.csv"), grains);
      }
    });
  failure.agree(comm_);
  write_manifest("running");
}

// Checkpoints from before the restart count as well. Later ones belong to a course that is given up: the next restart must not
// take them, so this comes before anything of that course is removed, and they are the first to go.
void Simulation::find_saved() {
  const std::string own = checkpoint_name();
  std::vector<std::string> earlier;
  for (const std::string& name : io::list_checkpoints(settings_.output.dir)) {
    const std::string file = path(name);
    if (file.size() < own.size() || (file.size() == own.size() && file <= own))
      earlier.push_back(file);
    else
      io::complete_file(file, file + GIVEN_UP);
  }
  for (const auto& e : std::filesystem::directory_iterator(settings_.output.dir)) {
    const std::string name = e.path().filename().string();
    if (name.starts_with("chk_") && name.ends_with(std::string(".h5") + GIVEN_UP)) saved_.push_back(path(name));
  }
  saved_.insert(saved_.end(), earlier.begin(), earlier.end());
}

void Simulation::remove_leftovers() const {
  const std::string last_plot = plot_name();
  const auto plotfile = [](const std::string& name) { return name.starts_with("plt_") && name.ends_with(".hdf"); };
  const auto later = [&](const std::string& name) { return name.size() > last_plot.size() || name > last_plot; };
  std::vector<std::filesystem::path> useless;
  for (const auto& e : std::filesystem::directory_iterator(settings_.output.dir)) {
    const std::string name = e.path().filename().string();
    const bool output = name.starts_with("plt_") || name.starts_with("chk_");
    const bool torn = output && name.ends_with(".part");
    // What an earlier run left here would be mistaken for this one's. A restart goes on with what it had written by then.
    const bool checkpoint = output && (name.ends_with(".h5") || name.ends_with(GIVEN_UP));
    const bool stale = resumed_ ? plotfile(name) && later(name) : name == "plt.hdf.series" || plotfile(name) || checkpoint;
    if (torn || stale) useless.push_back(e.path());
  }
  for (const auto& p : useless) std::filesystem::remove(p);
}

physics::Report Simulation::report() const {
  physics::Report r;
  for (const auto& m : modules_) m->report(r);
  return r;
}

void Simulation::write_line(const Totals& t, double dt) {
  if (mesh_->rank() != 0) return;
  const physics::Scales& s = settings_.scales;
  const physics::Report r = report();
  diagnostics_csv_->line({static_cast<double>(step_), time_ * s.tau0_s, time_, dt, static_cast<double>(t.blocks),
                          static_cast<double>(t.blocks * volume(filled(mesh_->layout().n))),
                          static_cast<double>(t.levels), t.solid_fraction, t.solute_mean * s.c_l_wt, solute_drift(t),
                          s.speed_um_s(r.max_speed), r.divergence_max, static_cast<double>(r.flow_iterations),
                          MPI_Wtime() - wall_start_, r.flow_residual});
}

void Simulation::write_tips(io::SharedFailure& failure) {
  const physics::Scales& s = settings_.scales;
  for (const physics::Tip& t : tips()) {
    const std::string name = fmt::format("{}.{}", t.grain, t.arm);
    double speed = 0;
    const auto last = last_tips_.find(name);
    if (last != last_tips_.end() && time_ > last->second[0])
      speed = (t.length - last->second[1]) / (time_ - last->second[0]);
    last_tips_[name] = {time_, t.length};
    if (mesh_->rank() != 0) continue;
    // Gravity points along -y (2D) or -z (3D); 0 degrees is down.
    const double euler = std::acos(std::clamp(-t.direction[DIM - 1], -1.0, 1.0)) * 180 / M_PI;
    std::vector<double> line{time_ * s.tau0_s, static_cast<double>(t.grain), static_cast<double>(t.arm), euler};
    for (const double x : t.position) line.push_back(x * s.w0_um);
    line.push_back(s.speed_um_s(speed));
    line.push_back(t.radius * s.w0_um);
    line.push_back(t.off_axis_deg);
    failure.attempt(path("tips.csv"), "write a line", [&] { tips_csv_->line(line); });
  }
}

void Simulation::write_grains(io::SharedFailure& failure) {
  const physics::Scales& s = settings_.scales;
  const auto velocity = mesh_->fields().find("velocity_x");
  // Without a flow the motion is known, but volumes are not.
  if (!settings_.has_flow() || settings_.flow.prescribed()) {
    std::vector<physics::Seed> measured = crystals_;
    physics::measure_motion(*mesh_, psi_, {mesh_->fields().find("grain").value_or(-1)}, {velocity.value_or(-1)}, measured);
    for (std::size_t g = 0; g < crystals_.size(); ++g) crystals_[g].volume = measured[g].volume;
  }
  if (mesh_->rank() != 0) return;
  for (std::size_t g = 0; g < crystals_.size(); ++g) {
    const physics::Seed& c = crystals_[g];
    std::vector<double> line{time_ * s.tau0_s, static_cast<double>(g)};
    for (const double x : c.position) line.push_back(x * s.w0_um);
    for (const double v : c.velocity) line.push_back(s.speed_um_s(v));
    for (std::size_t a = DIM == 2 ? 2 : 0; a < 3; ++a) line.push_back(c.spin[a] / s.tau0_s);
    if (DIM == 2) line.push_back(c.angle);
    if (DIM == 3)
      for (const double q : physics::quaternion(c)) line.push_back(q);
    line.push_back(c.volume * std::pow(s.w0_um, DIM));
    line.push_back(c.nonrigidity);
    line.push_back(c.contacts);
    failure.attempt(path("grains.csv"), "write a line", [&] { grains_csv_->line(line); });
  }
}

void Simulation::write_plotfile() {
  const physics::Scales& s = settings_.scales;
  const amr::Layout& layout = mesh_->layout();
  const double k = s.k;
  auto of_state = [&](auto&& f) {
    return [this, &layout, f](int b, std::span<double> out) {
      const double* psi = mesh_->cells(psi_, b);
      const double* c = mesh_->cells(c_, b);
      std::size_t i = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
        const std::ptrdiff_t q = layout.offset(cell);
        out[i++] = f(b, physics::phi_of_psi(psi[q]), c[q]);
      });
    };
  };
  const auto own_alpha = mesh_->fields().find("alpha"), own_grain = mesh_->fields().find("grain");
  const auto of_field = [this, &layout](int id) {
    return [this, &layout, id](int b, std::span<double> out) {
      const double* values = mesh_->cells({id}, b);
      std::size_t i = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) { out[i++] = values[layout.offset(cell)]; });
    };
  };
  const double angle = crystals_.empty() ? 0 : std::atan2(crystals_[0].axes[0][1], crystals_[0].axes[0][0]);
  std::vector<PlotComponent> fields{
      {"phi", of_state([](int, double phi, double) { return phi; })},
      {"U", of_state([k](int, double phi, double c) { return physics::u_of_c(c, phi, k); })},
      {"c", of_state([&s](int, double, double c) { return c * s.c_l_wt; })},
      {"alpha", of_state([angle](int, double, double) { return angle; })},
  };
  if (own_alpha) fields.back().values = of_field(*own_alpha);
  if (own_grain && !own_alpha)
    fields.back().values = [this, &layout, own_grain](int b, std::span<double> out) {
      const double* grain = mesh_->cells({*own_grain}, b);
      std::size_t i = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
        const RealVec& axis = crystals_[at(static_cast<int>(grain[layout.offset(cell)]))].axes[0];
        out[i++] = std::atan2(axis[1], axis[0]);
      });
    };
  const auto zero = of_state([](int, double, double) { return 0.0; });
  const auto velocity = mesh_->fields().find("velocity_x"), pressure = mesh_->fields().find("pressure");
  for (int a = 0; a < DIM; ++a) {
    const auto at_centres = [this, &layout, &s, velocity, a](int b, std::span<double> out) {
      const double* v = mesh_->faces({*velocity}, a, b);
      std::size_t i = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
        const std::ptrdiff_t q = layout.offset(cell);
        out[i++] = s.speed_um_s(0.5 * (v[q] + v[q + layout.stride(a)]));
      });
    };
    fields.push_back({std::string("velocity_") + "xyz"[a], zero});
    if (velocity) fields.back().values = at_centres;
  }
  fields.push_back({"pressure", zero});
  if (pressure)
    fields.back().values = [this, &layout, pressure](int b, std::span<double> out) {
      const double* p = mesh_->cells({*pressure}, b);
      std::size_t i = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) { out[i++] = p[layout.offset(cell)]; });
    };
  fields.push_back({"level", of_state([this](int b, double, double) { return double(mesh_->block(b).index.level); })});
  fields.push_back({"rank", of_state([this](int, double, double) { return double(mesh_->rank()); })});
  fields.push_back({"grain", of_state([](int, double phi, double) { return phi > 0 ? 0.0 : -1.0; })});
  if (own_grain)
    fields.back().values = [this, &layout, own_grain](int b, std::span<double> out) {
      const double *grain = mesh_->cells({*own_grain}, b), *psi = mesh_->cells(psi_, b);
      std::size_t i = 0;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
        const std::ptrdiff_t q = layout.offset(cell);
        out[i++] = psi[q] > 0 ? grain[q] : -1.0;
      });
    };
  const std::string name = plot_name();
  write_plot(path(name), *mesh_, s, time_ * s.tau0_s, step_, fields);
  io::SharedFailure failure;
  if (mesh_->rank() == 0)
    failure.attempt(path("plt.hdf.series"), "list the plotfile",
                    [&] { io::append_series(path("plt.hdf.series"), name, time_ * s.tau0_s); });
  failure.agree(comm_);
}

void Simulation::write_checkpoint(const std::string& file) { io::write_checkpoint(file, *mesh_, state()); }

std::string Simulation::plot_name() const { return fmt::format("plt_{:07d}.hdf", step_); }

std::string Simulation::checkpoint_name() const { return path(fmt::format("chk_{:07d}.h5", step_)); }

void Simulation::save() {
  const std::string file = checkpoint_name();
  io::SharedFailure failure;  // a restart from this checkpoint relies on the lines before it
  for (io::CsvFile* csv : {diagnostics_csv_.get(), tips_csv_.get(), grains_csv_.get()})
    if (csv != nullptr) failure.attempt(settings_.output.dir, "bring lines to the disk", [&] { csv->sync(); });
  failure.agree(comm_);
  write_checkpoint(file);
  last_save_ = MPI_Wtime();
  if (mesh_->rank() != 0) return;
  std::erase(saved_, file);
  saved_.push_back(file);
  while (saved_.size() > at(settings_.output.keep_checkpoints)) {
    io::remove_quietly(saved_.front());
    saved_.erase(saved_.begin());
  }
}

io::Manifest Simulation::manifest(const std::string& status, const std::map<std::string, double>& phases) const {
  io::Manifest m;
  m.status = status;
  m.started = started_;
  m.ranks = mesh_->ranks();
  m.input = settings_.schema.resolved_toml();
  m.time_s = time_ * settings_.scales.tau0_s;
  m.steps = step_;
  m.wall_s = MPI_Wtime() - wall_start_;
  m.phases = phases;
  m.blocks = mesh_->tree().size();
  m.block_cells = mesh_->layout().n;
  return m;
}

void Simulation::write_manifest(const std::string& status, std::optional<int> exit_code) {
  std::map<std::string, double> phases = clock_.seconds();
  phases["ghost_fill"] = ghosts_->fill_seconds();
  phases["ghost_wait"] = ghosts_->wait_seconds();
  std::vector<double> values;
  for (const auto& [name, seconds] : phases) values.push_back(seconds);
  // Ranks know the same phases: names come from collective code.
  MPI_Allreduce(MPI_IN_PLACE, values.data(), static_cast<int>(values.size()), MPI_DOUBLE, MPI_SUM, comm_);
  std::size_t i = 0;
  for (auto& [name, seconds] : phases) seconds = values[i++] / mesh_->ranks();
  io::SharedFailure failure;
  if (mesh_->rank() == 0)
    failure.attempt(path("manifest.json"), "write the manifest", [&] {
      io::Manifest m = manifest(status, phases);
      m.exit_code = exit_code;
      io::write_manifest(path("manifest.json"), m);
    });
  failure.agree(comm_);
}

void Simulation::record_failure(io::Manifest m, int exit_code, const std::string& message) const {
  if (mesh_->rank() != 0) return;  // no messages between ranks once something has failed: times are those of this rank
  try {
    m.exit_code = exit_code;
    m.message = message;
    io::write_manifest(path("manifest.json"), m);
  } catch (const io::OutputError&) {
    // The folder cannot be written, which is what the message says in most cases.
  }
}

void Simulation::progress(const Totals& t, double dt, bool last) {
  if (mesh_->rank() != 0) return;
  const double now = MPI_Wtime();
  if (!last && now - last_progress_ < 1.0) return;
  last_progress_ = now;
  const double wall = now - wall_start_;
  const double done = settings_.end_time > 0 ? time_ / settings_.end_time : 1;
  const double left = time_ > first_time_ ? wall * (settings_.end_time - time_) / (time_ - first_time_) : 0;
  fmt::print("step {:7d}  t {:9.4g} s  {:5.1f} %  dt {:6.3f} tau0  cells {:8d}  solid {:7.4f}  wall {:6.1f} s  left {:6.1f} s\n",
             step_, time_ * settings_.scales.tau0_s, 100 * done, dt, t.blocks * volume(filled(mesh_->layout().n)),
             t.solid_fraction, wall, last ? 0 : left);
  std::fflush(stdout);
}

}  // namespace dendrift

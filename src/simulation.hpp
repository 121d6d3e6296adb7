/// \file
/// A run: state, one time step, and what is written when.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "amr/ghost.hpp"
#include "amr/mesh.hpp"
#include "amr/regrid.hpp"
#include "io/checkpoint.hpp"
#include "io/diagnostics.hpp"
#include "io/hdf5.hpp"
#include "io/manifest.hpp"
#include "physics/crystals.hpp"
#include "physics/module.hpp"
#include "guard.hpp"
#include "settings.hpp"
#include "snapshot.hpp"

namespace dendrift {

using physics::NumericalError;

/// Wall time by phase of the step, seconds of this rank.
class PhaseClock {
 public:
  template <class F>
  auto time(const char* phase, F&& f) {
    const double begin = MPI_Wtime();
    struct Stop {
      double& sum;
      double begin;
      ~Stop() { sum += MPI_Wtime() - begin; }
    } stop{seconds_[phase], begin};
    return f();
  }
  const std::map<std::string, double>& seconds() const { return seconds_; }

 private:
  std::map<std::string, double> seconds_;
};

/// Sums over the leaves, exact and independent of the distribution.
struct Totals {
  double solid_fraction = 0;
  double solute_mean = 0;  ///< in units of c_l
  std::int64_t blocks = 0;
  int levels = 0;
};

enum class Outcome { done, stopped };

/// What the program ends with, apart from 1 (unexpected).
namespace exit_code {
inline constexpr int done = 0, bad_input = 2, numerical_failure = 3, output_failure = 4, stopped = 75;
}

class Simulation {
 public:
  /// Builds the mesh and the initial state, or reads it from a checkpoint, which must go with the input unless
  /// `allow_changes` (see require_same_scene). Nothing is written. Collective.
  Simulation(Settings& settings, MPI_Comm comm, const std::optional<std::string>& checkpoint = std::nullopt,
             bool allow_changes = false);
  ~Simulation();

  /// Steps to the end, writing output. Returns `stopped` after a checkpoint if asked to stop (request_stop, wall
  /// clock limit). Throws NumericalError (state saved) or io::OutputError. Collective.
  Outcome run();

  /// Prints the derived numbers and an estimate of the cost, from two steps that it takes. Collective.
  void print_check();

  /// Safe in a signal handler.
  static void request_stop();

  // For tests and tools.
  void step(double dt);  ///< one step of physics, then the mesh if its time has come
  amr::Mesh& mesh() { return *mesh_; }
  amr::GhostExchange& ghosts() { return *ghosts_; }
  amr::CellField field(const std::string& name) const { return {mesh_->fields().find(name).value()}; }
  double time() const { return time_; }
  std::int64_t step_number() const { return step_; }
  Totals totals();
  std::vector<physics::Tip> tips();
  physics::Report report() const;
  const std::vector<physics::Seed>& crystals() const { return crystals_; }
  std::vector<physics::Seed>& crystals() { return crystals_; }
  double solute_drift(const Totals& t) const { return (t.solute_mean - initial_solute_) / initial_solute_; }
  double max_dt() const;
  void write_checkpoint(const std::string& path);
  const PhaseClock& clock() const { return clock_; }
  const Caution& caution() const { return caution_; }
  /// f(dt) is called before each step of run() and returns the step that is taken in its place.
  void before_step(std::function<double(double)> f) { before_step_ = std::move(f); }

 private:
  void build_initial_mesh();
  void require_memory(std::int64_t blocks, const amr::FieldTable& fields) const;
  void resume(const std::string& path, bool allow_changes);
  void recall(const std::string& file, const io::RunState& s);
  std::string origin() const;
  void require_later_end(const std::string& file, const io::RunState& s) const;
  bool adapt(double max_imbalance);
  void schedule_regrid();
  double next_stop() const;
  void check_totals(const Totals& t) const;
  void check_state() const;
  void keep_snapshot();
  /// Goes back to the state kept last and halves the step, in a handler of a NumericalError that it throws on if that was
  /// tried often enough. Collective.
  void go_back();
  void restore();

  enum class Request : std::uint8_t { none, checkpoint, stop };
  /// What signals and the wall clock ask for, the same on all ranks. Collective.
  Request agreed_request() const;
  std::optional<Outcome> iterate();  ///< what is due, and a step; a value at the end
  void open_output();
  void find_saved();
  void remove_leftovers() const;
  void write_line(const Totals& t, double dt);
  void write_tips(io::SharedFailure& failure);
  void write_grains(io::SharedFailure& failure);
  void write_plotfile();
  void save();
  io::Manifest manifest(const std::string& status, const std::map<std::string, double>& phases) const;
  void write_manifest(const std::string& status, std::optional<int> exit_code = std::nullopt);
  std::string leave_behind(std::string message);  ///< after a failure; returns the message, longer by what was saved
  void record_failure(io::Manifest m, int exit_code, const std::string& message) const;  // not collective, throws nothing of its own
  void progress(const Totals& t, double dt, bool last);
  std::string plot_name() const;
  std::string checkpoint_name() const;
  std::string path(const std::string& name) const { return settings_.output.dir + "/" + name; }
  io::RunState state() const;

  Settings& settings_;
  MPI_Comm comm_;
  physics::Modules modules_;
  std::unique_ptr<amr::Mesh> mesh_;
  std::unique_ptr<amr::GhostExchange> ghosts_;
  std::vector<physics::Seed> crystals_;
  amr::CellField psi_, c_;
  double time_ = 0, first_time_ = 0;  // tau0; first: of this run, a restart's is later
  std::int64_t step_ = 0, first_step_ = 0;  // that of the checkpoint after a restart
  std::int64_t next_regrid_ = 0;
  std::int64_t plots_ = 0, lines_ = 0, checkpoints_ = 0;  // written so far: the next is due at that multiple
  double initial_solute_ = 0;
  std::map<std::string, std::vector<double>> last_tips_;  // "grain.arm" -> time, length
  std::int64_t last_line_step_ = -1;
  bool resumed_ = false, starting_ = true;
  std::unique_ptr<io::CsvFile> diagnostics_csv_, tips_csv_, grains_csv_;
  std::vector<std::string> saved_;  // rank 0: checkpoints in the folder, the next to be removed first
  PhaseClock clock_;
  Snapshot snapshot_;
  Caution caution_;
  std::function<double(double)> before_step_;
  bool written_ = false;  // output since the snapshot
  double dt_ = 0;
  double wall_start_ = 0, last_save_ = 0, last_progress_ = 0;
  std::string started_;
};

}  // namespace dendrift

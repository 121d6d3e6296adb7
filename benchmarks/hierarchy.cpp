// The program's own parts on the mesh of a grown dendrite: ghosts, regridding, whole steps.
#include <fmt/format.h>
#include <unistd.h>

#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "common.hpp"
#include "physics/solidification.hpp"
#include "settings.hpp"
#include "simulation.hpp"

namespace dendrift::bench {

namespace {

// One crystal: inputs/verification/al_cu_free.toml or al_cu_free_3d.toml, in boxes whose finest cells are DX with blocks
// of any size. Many: more of them in the same box, whose mesh no longer fits into a core's caches.
enum class Crystals { one, many };

std::string input(Crystals crystals) {
  const double side = DIM == 2 ? 1024 : 102.4;
  const int across = crystals == Crystals::one ? 1 : DIM == 2 ? 6 : 2;
  const auto vector = [](const std::array<double, 3>& x) {
    return DIM == 2 ? fmt::format("[{}, {}]", x[0], x[1]) : fmt::format("[{}, {}, {}]", x[0], x[1], x[2]);
  };
  std::string text = fmt::format("run.end_time_tau0 = 1000\nmesh.dim = {}\nmesh.size_W0 = {}\nmesh.dx_W0 = {}\n", DIM,
                                 vector({side, side, side}), DX);
  for (int f = 0; f < FACES; ++f) text += fmt::format("mesh.{}{} = \"symmetry\"\n", "xyz"[f / 2], f % 2 != 0 ? "hi" : "lo");
  const int count = static_cast<int>(std::pow(across, DIM));
  for (int i = 0; i < count; ++i) {
    std::array<double, 3> at{};
    for (int a = 0, rest = i; a < 3; ++a, rest /= across)
      at[static_cast<std::size_t>(a)] = across == 1 ? 0.0 : (rest % across + 0.5) * side / across;
    text += fmt::format("[[seed]]\nposition_W0 = {}\nradius_W0 = 10\n", vector(at));
  }
  return text;
}
constexpr double GROWN = DIM == 2 ? 100 : 20;  // tau0

/// Checkpoints of grown crystals, so that every benchmark starts from the same state.
class Checkpoints {
 public:
  ~Checkpoints() {
    for (const auto& [key, file] : files_) std::filesystem::remove(file);
  }
  const std::string& grown(Crystals crystals, int n) {
    std::string& file = files_[{crystals, n}];
    if (!file.empty()) return file;
    Settings settings;
    settings.parse_text(input(crystals), "benchmark", {fmt::format("mesh.block_cells={}", n)});
    Simulation simulation(settings, MPI_COMM_SELF);
    while (simulation.time() < GROWN) simulation.step(simulation.max_dt());
    file = std::filesystem::temp_directory_path() / fmt::format("dendrift-bench-{}-{}.h5", getpid(), files_.size());
    simulation.write_checkpoint(file);
    return file;
  }

 private:
  std::map<std::pair<Crystals, int>, std::string> files_;
};

/// A run that goes on from there.
struct Run {
  Settings settings;
  std::unique_ptr<Simulation> simulation;
  double dt = 0;
  int stages = 0;

  Run(Crystals crystals, std::int64_t n) {
    static Checkpoints checkpoints;
    const std::string& file = checkpoints.grown(crystals, static_cast<int>(n));
    settings.parse_text(input(crystals), "benchmark", {fmt::format("mesh.block_cells={}", n)});
    simulation = std::make_unique<Simulation>(settings, MPI_COMM_SELF, file);
    // The number of stages is the growth module's own affair: ask another one with the same memory. The step is a
    // little shorter than it may be, so that the number stays the same as the front changes its speed.
    dt = 0.95 * simulation->max_dt();
    physics::Solidification growth(settings.phase_field, settings.solute, settings.scales,
                                   physics::make_seeds(settings.seed, settings.scales));
    growth.attach(mesh(), simulation->ghosts());
    growth.recall(io::read_state(file, MPI_COMM_SELF).numbers.at(std::string("module.") + growth.name()));
    stages = growth.stages(dt);
  }
  amr::Mesh& mesh() const { return simulation->mesh(); }
  double cells() const { return static_cast<double>(mesh().size() * volume(filled(mesh().layout().n))); }
  std::vector<amr::CellField> fields() const { return {simulation->field("psi"), simulation->field("c")}; }
  /// Takes a step, regridding included if it is due; returns the cell updates done.
  double step() const {
    simulation->step(dt);
    return cells() * stages;
  }

  /// How the cells and the time are spread: by kind of block, and by part of the step.
  void describe(benchmark::State& state) const {
    std::array<double, 3> kinds{};
    for (int b = 0; b < mesh().size(); ++b)
      ++kinds[static_cast<std::size_t>(physics::classify(mesh().cells(fields()[0], b), mesh().layout().n))];
    state.counters["stages"] = stages;
    state.counters["blocks"] = mesh().size();
    state.counters["cells"] = cells();
    state.counters["interface_share"] = kinds[2] / mesh().size();
    state.counters["solid_share"] = kinds[1] / mesh().size();
    const auto& clock = simulation->clock().seconds();
    double total = 0;
    for (const auto& [name, seconds] : clock) total += seconds;
    if (total == 0) return;
    state.counters["regrid_time_share"] = clock.contains("regrid") ? clock.at("regrid") / total : 0.0;
    state.counters["ghost_time_share"] = simulation->ghosts().fill_seconds() / total;
  }
};

void ghost_fill(benchmark::State& state, Crystals crystals) {
  const Run run(crystals, state.range(0));
  for (auto _ : state) run.simulation->ghosts().fill(run.fields());
  state.counters["Mcell_per_s"] = mcells(run.cells());
}

void step_hierarchy(benchmark::State& state, Crystals crystals) {
  const Run run(crystals, state.range(0));
  run.step();
  double updates = 0;
  for (auto _ : state) updates += run.step();
  state.counters["Mcell_per_s"] = {1e-6 * updates, benchmark::Counter::kIsRate};
  run.describe(state);
}

// Fill ghosts, tag, propose, regrid. The buffer around the interface is widened and narrowed in turn, so that every
// call has something to refine or to coarsen.
void regrid(benchmark::State& state, Crystals crystals) {
  const Run run(crystals, state.range(0));
  const amr::CellField psi = run.fields()[0], c = run.fields()[1];
  amr::Mesh& mesh = run.mesh();
  double cells = 0, changed = 0;
  const auto change = [&](int buffer_cells) {
    physics::PhaseFieldOptions options = run.settings.phase_field;
    options.buffer_cells = buffer_cells;
    run.simulation->ghosts().fill(run.fields());
    std::vector<amr::Tag> tags(static_cast<std::size_t>(mesh.size()));
    amr::parallel_for(mesh.size(), [&](int b) {
      amr::Tag& tag = tags[static_cast<std::size_t>(b)];
      physics::tag_interface(mesh, psi, options, b, tag);
      physics::tag_solute(mesh, psi, c, run.settings.scales, run.settings.solute, b, tag);
    });
    const int before = mesh.size();
    amr::regrid(mesh, run.simulation->ghosts(), amr::propose(mesh, tags), {});
    cells += run.cells();
    changed += std::abs(mesh.size() - before);
  };
  const std::array<int, 2> buffers{mesh.layout().n, run.settings.phase_field.buffer_cells};
  std::size_t turn = 0;
  for (auto _ : state) change(buffers[turn++ % 2]);
  state.counters["Mcell_per_s"] = {1e-6 * cells, benchmark::Counter::kIsRate};
  state.counters["net_change_blocks"] = {changed, benchmark::Counter::kAvgIterations};
}

// Whole steps against steps of as many stages, ghosts filled, on the uniform grid.
void paired_step_vs_plain(benchmark::State& state, Crystals crystals) {
  const Run run(crystals, state.range(0));
  PlainAlloy plain(CELLS, DX);
  set_sample(plain);
  const double h = run.settings.shape.dx(run.settings.shape.max_level);
  const int s = run.stages;
  const double w = 2.0 / (s * s + s) * run.dt * (DX * DX) / (h * h);
  const auto plain_step = [&] {
    for (int j = 1; j <= s; ++j) {
      plain.fill_ghosts();
      plain.advance(alloy(), j == 1 ? physics::Stage{0, w} : physics::Stage{(1.0 - j) / j, (2.0 * j - 1) / j * w});
      plain.swap();
    }
    return std::pow(CELLS, DIM) * s;
  };
  // A step on a small mesh is too short to time; a pair takes as many as last about as long as one on the grid.
  run.step();
  plain_step();
  const int steps = std::max(1, static_cast<int>(timed(plain_step) / timed([&] { run.step(); })));
  run_pairs(
      state,
      [&] {
        double updates = 0;
        for (int i = 0; i < steps; ++i) updates += run.step();
        return updates;
      },
      plain_step);
  run.describe(state);
}

void block_sizes(benchmark::internal::Benchmark* b) {
  for (const int n : {8, 16, 32})
    if (DIM == 2 || n < 32) b->Arg(n);
}

#define ONE_AND_MANY(function, ...)                                                           \
  BENCHMARK_CAPTURE(function, one, Crystals::one)->Name(#function)->Apply(block_sizes)->__VA_ARGS__; \
  BENCHMARK_CAPTURE(function, many, Crystals::many)->Name(#function "_many")->Apply(block_sizes)->__VA_ARGS__

ONE_AND_MANY(ghost_fill, Apply(repeated));
ONE_AND_MANY(step_hierarchy, Apply(repeated)->Iterations(DIM == 2 ? 50 : 10));
ONE_AND_MANY(regrid, Apply(repeated)->Iterations(20));
ONE_AND_MANY(paired_step_vs_plain, Apply(in_pairs));

}  // namespace

}  // namespace dendrift::bench

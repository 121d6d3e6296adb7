#include "restart.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <optional>

#include "io/hdf5.hpp"
#include "simulation.hpp"

namespace dendrift {

namespace {

// Places in shape_numbers().
constexpr std::size_t BLOCK_CELLS = 0, ROOT_DX = 2, CRYSTALS = 8, ROOT_BLOCKS = 9;

std::optional<std::vector<double>> number(const io::RunState& state, const std::string& name) {
  const auto found = state.numbers.find(name);
  return found == state.numbers.end() ? std::nullopt : std::optional(found->second);
}

// How long, what is written and who computes it do not change the course.
bool free_to_change(const std::string& key) {
  constexpr const char* RUN[] = {"run.title", "run.end_time_s", "run.end_time_tau0", "run.max_steps", "run.wall_clock_limit_s"};
  return key.starts_with("output.") || key.starts_with("parallel.") || std::ranges::find(RUN, key) != std::end(RUN);
}

std::vector<io::InputChange> changes(const Settings& settings, const io::RunState& state) {
  std::vector<io::InputChange> all = settings.schema.changes_since(state.input);
  const auto before = number(state, "seeds_file");
  const auto now = settings.seeds_checksum();
  if (before && now && before->at(0) != *now)
    all.push_back({"seeds.file", fmt::format("content with the checksum {:.0f}", before->at(0)),
                   fmt::format("content with the checksum {}", *now)});
  return all;
}

void refuse_changes(const Settings& settings, const std::string& file, const io::RunState& state) {
  std::vector<io::InputIssue> issues;
  for (const io::InputChange& c : changes(settings, state)) {
    if (free_to_change(c.key)) continue;
    issues.push_back(settings.schema.issue(c.key, fmt::format("{}, as in {}", c.before, file), c.after));
    issues.back().hint = "a restart keeps physics and mesh; --allow-changes continues with the new value";
  }
  if (!issues.empty()) throw io::InputError(std::move(issues));
}

// What no flag can change, because the arrays of the checkpoint would not fit.
void require_same_blocks(const Settings& settings, const std::string& file, const io::RunState& state) {
  if (state.dim != DIM)
    throw settings.schema.error("mesh.dim", fmt::format("{}, as in {}", state.dim, file), std::to_string(DIM));
  const std::vector<double> was = number(state, "shape").value_or(std::vector<double>()), is = shape_numbers(settings);
  if (was.size() != is.size()) throw io::OutputError(file, "restart", "it does not hold the shape of the mesh");
  const auto same = [&](const std::string& key, std::size_t first, std::size_t count = 1) {
    for (std::size_t i = first; i < first + count; ++i)
      if (was[i] != is[i])
        throw settings.schema.error(key, fmt::format("what gives {} as in {}, also with --allow-changes", was[i], file),
                                    fmt::format("{}", is[i]));
  };
  const std::string box = settings.mesh.size_w0 ? "mesh.size_W0" : "mesh.size_um";
  same("mesh.block_cells", BLOCK_CELLS);
  same(settings.mesh.root_blocks ? "mesh.root_blocks" : box, ROOT_BLOCKS, DIM);
  same(box, ROOT_DX);
  same(settings.schema.has_table("seeds") ? "seeds" : "seed", CRYSTALS);
}

}  // namespace

std::vector<double> shape_numbers(const Settings& s) {
  std::vector<double> n{static_cast<double>(s.shape.block_cells), static_cast<double>(s.shape.max_level),
                        s.shape.root_dx,  s.scales.k, s.scales.lambda, s.scales.w0_um, s.scales.tau0_s,
                        s.scales.supersaturation, static_cast<double>(s.crystals.size())};
  for (int a = 0; a < DIM; ++a) n.push_back(s.shape.root_blocks[a]);
  for (const amr::Side side : s.shape.sides) n.push_back(static_cast<double>(side));
  return n;
}

void require_same_scene(const Settings& settings, const std::string& file, const io::RunState& state, bool allow_changes) {
  if (!allow_changes) refuse_changes(settings, file, state);
  require_same_blocks(settings, file, state);
  if (!allow_changes && number(state, "shape") != shape_numbers(settings))
    throw io::OutputError(file, "restart", "this version derives other numbers (W0, tau0, levels) from the same input than the "
                                           "one that wrote it; --allow-changes continues with the new ones");
}

std::string restart_log(const Settings& settings, const std::string& file, const io::RunState& state, const std::string& origin) {
  std::string log = fmt::format("restart from {}: step {}, t = {:.6g} s\n", file, state.step, state.time * settings.scales.tau0_s);
  if (state.format == 1) log += "restart: the checkpoint is of an older version and has no checksums\n";
  if (state.origin != origin && !state.origin.empty()) log += fmt::format("restart: {}\nbefore:  {}\n", origin, state.origin);
  for (const io::InputChange& c : changes(settings, state))
    log += fmt::format("restart: {}{}: {} -> {}\n", free_to_change(c.key) ? "" : "CHANGES ", c.key, c.before, c.after);
  return log;
}

std::unique_ptr<Simulation> restart(Settings& settings, MPI_Comm comm, const std::string& file_or_dir, bool allow_changes) {
  const std::vector<std::string> files = io::find_checkpoints(file_or_dir, comm);
  int rank = 0;
  MPI_Comm_rank(comm, &rank);
  std::string reasons;
  for (const std::string& file : files) {
    try {
      return std::make_unique<Simulation>(settings, comm, file, allow_changes);
    } catch (const io::OutputError& e) {
      if (files.size() == 1) throw;
      if (rank == 0) fmt::print(stderr, "dendrift: warning: passed over {}\n", e.what());
      reasons += fmt::format("\n  {}", e.what());
    }
  }
  throw io::OutputError(file_or_dir, "restart", "none of its checkpoints is sound:" + reasons);
}

}  // namespace dendrift

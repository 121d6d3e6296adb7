#include "settings.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <optional>
#include <span>
#include <stdexcept>
#include <utility>

#include "io/crc32.hpp"

namespace dendrift {

namespace {

// One quantity in two units: an override in one replaces what the file says in the other.
template <class T>
void override_twin(const io::Checks& c, const std::string& a, std::optional<T>& x, const std::string& b,
                   std::optional<T>& y) {
  if (!x || !y || c.overridden(a) == c.overridden(b)) return;
  (c.overridden(a) ? y : x).reset();
}

// Every rank holds the whole tree, and root blocks are there from the start.
void require_sane_tree(io::Checks& checks, const amr::MeshShape& shape, const MeshOptions& o) {
  const std::string size = o.size_w0 ? "mesh.size_W0" : "mesh.size_um";
  double blocks = 1;
  for (const int r : shape.root_blocks) blocks *= r;
  const std::string found = fmt::format("{} = {:.0f} root blocks, {} levels", fmt::join(shape.root_blocks, " x "), blocks,
                                        shape.max_level + 1);
  if (blocks > MOST_ROOT_BLOCKS)
    checks.fail(o.root_blocks ? "mesh.root_blocks" : size,
                fmt::format("at most {} root blocks; more levels give as fine cells with fewer", MOST_ROOT_BLOCKS), found);
  if (!amr::Tree::fits(shape.root_blocks, shape.max_level))
    checks.fail(o.root_blocks ? "mesh.levels" : size,
                fmt::format("at most {} blocks along an axis on the finest level", amr::Tree::MOST_ALONG_AXIS), found);
}

// Each key of the alloy is in its range, but together they may leave the range of a double.
bool finite(const physics::Scales& s) {
  return std::ranges::all_of(std::array{s.c_l_wt, s.d0_um, s.w0_um, s.tau0_s, s.viscosity},
                             [](double x) { return std::isfinite(x) && x > 0; });
}

// A device or a pipe might never end.
bool may_be_read(const std::filesystem::path& path) {
  std::error_code none;
  return !std::filesystem::exists(path, none) || std::filesystem::is_regular_file(path, none);
}

}  // namespace

void RunOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("run", "how long", io::Schema::Presence::required);
  t.text("title", title).doc("for the reader; goes into manifest.json");
  t.real("end_time_s", end_time_s).unit("s").at_least(0).doc("simulated time at which the run ends; or end_time_tau0");
  t.real("end_time_tau0", end_time_tau0).unit("tau0").at_least(0).doc("the same in units of tau0");
  t.integer("max_steps", max_steps).at_least(0).doc("time steps after which the run ends at the latest");
  t.real("wall_clock_limit_s", wall_clock_limit_s)
      .unit("s")
      .at_least(0)
      .doc("running time after which a checkpoint is written and the program ends with exit code 75; 0: none");
  schema.check({"run"}, [this](io::Checks& c) {
    override_twin(c, "run.end_time_s", end_time_s, "run.end_time_tau0", end_time_tau0);
    if (end_time_s.has_value() == end_time_tau0.has_value())
      c.fail("run", "exactly one of end_time_s and end_time_tau0", end_time_s ? "both" : "neither");
  });
}

void MeshOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("mesh", "box and blocks", io::Schema::Presence::required);
  t.integer("dim", dim).range(2, 3).required().doc("space dimensions");
  t.reals("size_um", size_um).unit("um").above(0).doc("sides of the box; or size_W0");
  t.reals("size_W0", size_w0).unit("W0").above(0).doc("sides of the box");
  t.real("dx_W0", dx_w0).unit("W0").range(0.05, 4).doc("upper limit of the finest cell spacing");
  t.integer("block_cells", block_cells).range(8, 32).doc("cells along a side of a block: 8, 16 or 32");
  t.integers("root_blocks", root_blocks).at_least(1).doc("blocks of the coarsest level along each axis, instead of dx_W0");
  t.integer("levels", levels).range(1, 16).doc("levels of refinement, with root_blocks; 1 is a uniform mesh");
  using amr::Side;
  const std::vector<std::pair<std::string, Side>> cases{
      {"wall", Side::wall}, {"symmetry", Side::symmetry}, {"open", Side::open}, {"periodic", Side::periodic}};
  const char* names[] = {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"};
  for (std::size_t f = 0; f < 6; ++f)
    t.choice(names[f], sides[f], cases).doc(f < 4 ? "side of the box" : "side of the box; 3D only");
  t.integer("max_regrid_steps", max_regrid_steps).range(1, 1000).doc("steps between changes of the mesh at most");
  schema.check({"mesh"}, [this](io::Checks& c) {
    if (dim != DIM) return;  // the launcher picks the program; nothing else can be right in the wrong one
    override_twin(c, "mesh.size_um", size_um, "mesh.size_W0", size_w0);
    if (size_um.has_value() == size_w0.has_value())
      c.fail("mesh", "exactly one of size_um and size_W0", size_um ? "both" : "neither");
    if (block_cells != 8 && block_cells != 16 && block_cells != 32) c.fail("mesh.block_cells", "8, 16 or 32");
    if (root_blocks.has_value() != levels.has_value())
      c.fail("mesh", "root_blocks and levels together, or neither", root_blocks ? "root_blocks alone" : "levels alone");
    const char* lo_hi[] = {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"};
    for (std::size_t f = 0; f < FACES; f += 2)
      if ((sides[f] == amr::Side::periodic) != (sides[f + 1] == amr::Side::periodic))
        c.fail(std::string("mesh.") + lo_hi[sides[f] == amr::Side::periodic ? f : f + 1],
               "opposite sides both periodic, or neither");
  });
}

void ParallelOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("parallel", "distribution over ranks; never changes results", io::Schema::Presence::implied);
  t.choice("partitioner", partitioner, {{"curve", amr::Partitioner::curve}, {"graph", amr::Partitioner::graph}})
      .doc("weighted Morton curve, or METIS on the graph of blocks");
  t.real("max_imbalance", max_imbalance).range(1, 10).doc("largest load over mean load before blocks move");
}

void OutputOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("output", "files", io::Schema::Presence::implied);
  t.text("dir", dir).doc("folder for all output, made if it does not exist");
  t.real("plot_every_s", plot_every_s).unit("s").above(0).doc("time between plotfiles; or plot_every_tau0; neither: first and last state");
  t.real("plot_every_tau0", plot_every_tau0).unit("tau0").above(0).doc("the same in units of tau0");
  t.real("diagnostics_every_s", diagnostics_every_s).unit("s").above(0).doc("time between lines of the CSV files; default a hundredth of the run");
  t.real("diagnostics_every_tau0", diagnostics_every_tau0).unit("tau0").above(0).doc("the same in units of tau0");
  t.real("checkpoint_every_s", checkpoint_every_s).unit("s").at_least(0).doc("simulated time between checkpoints; 0: none but at the end of a stopped run");
  t.integer("checkpoint_every_steps", checkpoint_every_steps).at_least(0).doc("time steps between checkpoints; 0: none");
  t.real("checkpoint_every_wall_s", checkpoint_every_wall_s)
      .unit("s")
      .at_least(0)
      .doc("running time between checkpoints; 0: none");
  t.integer("keep_checkpoints", keep_checkpoints).at_least(1).doc("checkpoints kept; older ones are removed");
  schema.check({"output"}, [this](io::Checks& c) {
    override_twin(c, "output.plot_every_s", plot_every_s, "output.plot_every_tau0", plot_every_tau0);
    override_twin(c, "output.diagnostics_every_s", diagnostics_every_s, "output.diagnostics_every_tau0",
                  diagnostics_every_tau0);
    if (plot_every_s && plot_every_tau0) c.fail("output.plot_every_tau0", "not together with plot_every_s");
    if (diagnostics_every_s && diagnostics_every_tau0)
      c.fail("output.diagnostics_every_tau0", "not together with diagnostics_every_s");
    if (dir.empty()) c.fail("output.dir", "the name of a folder");
  });
}

Settings::Settings() {
  run.declare(schema);
  mesh.declare(schema);
  alloy.declare(schema);
  physics::SeedOptions::declare(schema, seed);
  seeding.declare(schema);
  phase_field.declare(schema);
  solute.declare(schema);
  orientation.declare(schema);
  flow.declare(schema);
  parallel.declare(schema);
  output.declare(schema);
  guard.declare(schema);
  schema.check([this](io::Checks& checks) {
    if (mesh.dim != DIM) {
      checks.fail("mesh.dim", std::to_string(DIM) + " in this program (the launcher `dendrift` picks the right one)");
      return;
    }
    // The checks before this one have reported what is missing; it must not be read.
    const bool sized = mesh.size_w0 || mesh.size_um;
    const bool nothing_to_draw = seeding.count > 0 && !seeding.radius_w0 && !seeding.radius_um;
    const bool seeded = !nothing_to_draw && std::ranges::all_of(seed, [](const physics::SeedOptions& o) {
      return (o.position_w0 || o.position_um) && (o.radius_w0 || o.radius_um);
    });
    const physics::Scales s(alloy);
    if (!finite(s)) {
      checks.fail("alloy", "numbers that give finite units of length and time",
                  fmt::format("W0 = {:.3g} um, tau0 = {:.3g} s, viscosity = {:.3g} W0^2/tau0", s.w0_um, s.tau0_s, s.viscosity));
      return;
    }
    if (!seeding.file.empty() && !may_be_read(std::filesystem::path(folder_) / seeding.file)) {
      checks.fail("seeds.file", "a file, or a link to one");
      return;
    }
    RealVec size{};
    for (int a = 0; sized && a < DIM; ++a) size[a] = mesh.size_w0 ? (*mesh.size_w0)[a] : (*mesh.size_um)[a] / s.w0_um;
    try {
      if (sized && mesh.root_blocks.has_value() == mesh.levels.has_value())
        require_sane_tree(checks, choose_shape(size, mesh), mesh);
    } catch (const std::invalid_argument& e) {
      checks.fail("mesh", e.what(), "a box that does not fit");
    }
    // Steps end on output times, so these must not be shorter than steps worth taking.
    constexpr double SHORTEST = 1e-3;  // tau0
    const std::pair<const char*, std::optional<double>> intervals[] = {
        {"output.plot_every_s", output.plot_every_s ? *output.plot_every_s / s.tau0_s : output.plot_every_s},
        {"output.plot_every_tau0", output.plot_every_tau0},
        {"output.diagnostics_every_s",
         output.diagnostics_every_s ? *output.diagnostics_every_s / s.tau0_s : output.diagnostics_every_s},
        {"output.diagnostics_every_tau0", output.diagnostics_every_tau0}};
    for (const auto& [key, tau0] : intervals)
      if (tau0 && *tau0 < SHORTEST) checks.fail(key, "at least .001 tau0: steps end on output times");
    std::vector<std::pair<std::string, std::optional<double>>> times = {{"run.end_time_s", run.end_time_s},
                                                                        {"output.plot_every_s", output.plot_every_s},
                                                                        {"output.diagnostics_every_s", output.diagnostics_every_s},
                                                                        {"output.checkpoint_every_s", output.checkpoint_every_s},
                                                                        {"seeds.last_nucleation_time_s", seeding.last_time_s}};
    for (std::size_t i = 0; i < seed.size(); ++i) times.emplace_back(fmt::format("seed[{}].nucleation_time_s", i), seed[i].nucleation_time_s);
    for (const auto& [key, seconds] : times)
      if (seconds && !std::isfinite(*seconds / s.tau0_s)) checks.fail(key, fmt::format("a time that is finite in tau0 = {:.3g} s", s.tau0_s));
    if (sized && mesh.root_blocks.has_value() == mesh.levels.has_value() && checks.has_table("flow")) {
      try {
        flow.check_sides(checks, choose_shape(size, mesh));
      } catch (const std::invalid_argument&) {  // reported above
      }
    }
    if (!sized || !seeded || mesh.root_blocks.has_value() != mesh.levels.has_value()) return;
    std::vector<physics::SeedOptions> all = seed;
    try {
      all = all_seeds(choose_shape(size, mesh), s);
    } catch (const physics::SeedingProblem& p) {
      checks.fail(p.key, p.expected, p.found);
    } catch (const std::invalid_argument&) {  // reported above
    }
    const std::vector<physics::Seed> seeds = physics::make_seeds(all, s);
    const auto held = std::ranges::count_if(seeds, &physics::Seed::held);
    if (held > 0 && flow.prescribed())
      checks.fail("flow", "a velocity that is solved for, where crystals are held", "a prescribed one");
    if (checks.has_table("flow") && held > 0 && held < std::ssize(seeds) && flow.solid == physics::SolidModel::viscous &&
        flow.motion == physics::Motion::free)
      checks.fail("flow.solid", "\"penalised\", where some crystals are held and others free", "\"viscous\"");
    for (std::size_t i = 0; i < seeds.size(); ++i) {
      const auto fail = [&](const std::string& key, const std::string& expected) {
        if (i < seed.size()) {
          checks.fail(fmt::format("seed[{}].{}", i, key), expected);
        } else {
          checks.fail("seeds.file", fmt::format("{}; seed {} of the file differs", expected, i - seed.size() + 1));
        }
      };
      if (!std::isfinite(seeds[i].radius) || seeds[i].radius <= 0)
        fail(all[i].radius_w0 ? "radius_W0" : "radius_um", fmt::format("a radius that is a positive number of W0 = {:.3g} um", s.w0_um));
      if (!(seeds[i].inner_radius < seeds[i].radius))
        fail(all[i].inner_radius_w0 ? "inner_radius_W0" : "inner_radius_um", fmt::format("less than the radius, {:.4g} W0", seeds[i].radius));
      for (int a = 0; a < DIM; ++a)
        if (!(seeds[i].position[a] >= 0 && seeds[i].position[a] <= size[a]))
          fail(all[i].position_w0 ? "position_W0" : "position_um", "a point inside the box");
    }
  });
}

std::vector<physics::SeedOptions> Settings::all_seeds(const amr::MeshShape& box, const physics::Scales& s) const {
  std::vector<physics::SeedOptions> all = seed;
  for (const auto& more : {seeding.from_file(folder_, s), seeding.at_random(box, s)}) all.insert(all.end(), more.begin(), more.end());
  return all;
}

void Settings::parse(const std::string& path, const std::vector<std::string>& overrides) {
  folder_ = std::filesystem::path(path).parent_path().string();
  schema.parse(path, overrides);
  derive();
}

void Settings::parse_text(const std::string& toml, const std::string& name, const std::vector<std::string>& overrides) {
  schema.parse_text(toml, name, overrides);
  derive();
}

void Settings::derive() {
  scales = physics::Scales(alloy);
  RealVec size{};
  for (int a = 0; a < DIM; ++a) size[a] = mesh.size_w0 ? (*mesh.size_w0)[a] : (*mesh.size_um)[a] / scales.w0_um;
  shape = choose_shape(size, mesh);
  crystals = physics::make_seeds(all_seeds(shape, scales), scales);
  if (!seeding.file.empty()) {
    std::ifstream in(std::filesystem::path(folder_) / seeding.file, std::ios::binary);
    const std::string text((std::istreambuf_iterator<char>(in)), {});
    seeds_checksum_ = io::crc32(std::as_bytes(std::span(text)));
  }
  const auto in_tau0 = [&](const std::optional<double>& s, const std::optional<double>& tau0, double otherwise) {
    return tau0 ? *tau0 : s ? *s / scales.tau0_s : otherwise;
  };
  end_time = in_tau0(run.end_time_s, run.end_time_tau0, 0);
  plot_interval = in_tau0(output.plot_every_s, output.plot_every_tau0, 0);
  diagnostics_interval = in_tau0(output.diagnostics_every_s, output.diagnostics_every_tau0, end_time / 100);
}

amr::MeshShape choose_shape(const RealVec& size, const MeshOptions& o) {
  amr::MeshShape shape;
  shape.block_cells = o.block_cells;
  std::copy_n(o.sides.begin(), FACES, shape.sides.begin());
  const double n = o.block_cells;
  const auto near_integer = [](double x) { return std::abs(x - std::round(x)) < 1e-6 * std::max(1.0, x); };
  if (o.root_blocks) {
    shape.root_blocks = *o.root_blocks;
    shape.max_level = *o.levels - 1;
    shape.root_dx = size[0] / ((*o.root_blocks)[0] * n);
    for (int a = 1; a < DIM; ++a)
      if (!near_integer(size[a] / (shape.root_dx * n)) ||
          std::round(size[a] / (shape.root_dx * n)) != (*o.root_blocks)[a])
        throw std::invalid_argument("root_blocks in proportion to the sides of the box, so that cells are cubes");
    return shape;
  }
  for (const double side : size)
    if (side / (n * o.dx_w0) > static_cast<double>(amr::Tree::MOST_ALONG_AXIS))
      throw std::invalid_argument(fmt::format("sides of at most {} blocks of {} cells of dx_W0 = {}",
                                              amr::Tree::MOST_ALONG_AXIS, o.block_cells, o.dx_w0));
  // The tree of `level` refinements with the coarsest cells that are not above dx_w0; none if its blocks do not tile.
  const auto tree = [&](int level) -> std::optional<amr::MeshShape> {
    const double unit = n * static_cast<double>(1 << level);
    const int least = std::max(1, static_cast<int>(std::ceil(size[0] / (unit * o.dx_w0) - 1e-9)));
    for (int r = least; r < least + 16; ++r) {
      bool fits = true;
      for (int a = 0; a < DIM; ++a) {
        const double x = size[a] / size[0] * r;
        fits = fits && near_integer(x) && std::round(x) >= 1 && x <= static_cast<double>(amr::Tree::MOST_ALONG_AXIS);
        if (fits) shape.root_blocks[a] = static_cast<int>(std::round(x));
      }
      if (!fits) continue;
      shape.max_level = level;
      shape.root_dx = size[0] / (n * r);
      return shape;
    }
    return std::nullopt;
  };
  // Deep trees first: few root blocks are what multigrid wants. Cells a little smaller than asked for are a price worth
  // paying for them.
  constexpr std::array<std::pair<int, double>, 4> PREFERENCES{{{2, 0.93}, {2, 0.8}, {1, 0.93}, {2, 0.6}}};
  constexpr int DEEPEST = 14;
  for (const auto& [fewest_levels, least_dx] : PREFERENCES)
    for (int level = DEEPEST; level >= fewest_levels; --level)
      if (const auto found = tree(level); found && found->dx(level) >= (least_dx - 1e-9) * o.dx_w0) return *found;
  std::optional<amr::MeshShape> coarsest;
  for (int level = DEEPEST; level >= 0; --level)
    if (const auto found = tree(level); found && (!coarsest || found->dx(level) > coarsest->dx(coarsest->max_level)))
      coarsest = found;
  if (coarsest) return *coarsest;
  throw std::invalid_argument("sides in the ratio of small whole numbers, so that cubes tile the box");
}

}  // namespace dendrift

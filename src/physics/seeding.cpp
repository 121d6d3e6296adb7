#include "physics/seeding.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <numbers>

#include "amr/loops.hpp"
#include "physics/counter_random.hpp"

namespace dendrift::physics {

namespace {

std::string trimmed(const std::string& text) {
  const auto first = text.find_first_not_of(" \t\r");
  if (first == std::string::npos) return {};
  return text.substr(first, text.find_last_not_of(" \t\r") - first + 1);
}

std::vector<std::string> fields_of(const std::string& line) {
  std::vector<std::string> fields;
  for (std::size_t begin = 0;;) {
    const std::size_t comma = line.find(',', begin);
    fields.push_back(trimmed(line.substr(begin, comma == std::string::npos ? comma : comma - begin)));
    if (comma == std::string::npos) return fields;
    begin = comma + 1;
  }
}

// One row; `where` names it in messages.
class Row {
 public:
  Row(const std::vector<std::string>& header, const std::vector<std::string>& fields, std::string where)
      : header_(header), fields_(fields), where_(std::move(where)) {}

  std::optional<double> number(const std::string& column) const {
    const auto found = std::ranges::find(header_, column);
    if (found == header_.end()) return std::nullopt;
    const std::string& text = fields_[static_cast<std::size_t>(found - header_.begin())];
    double x = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), x);
    if (error != std::errc() || end != text.data() + text.size() || !std::isfinite(x))
      fail("a number in column " + column, text.empty() ? "nothing" : text);
    return x;
  }
  [[noreturn]] void fail(const std::string& expected, const std::string& found) const {
    throw SeedingProblem("seeds.file", where_ + ": " + expected, found);
  }

 private:
  const std::vector<std::string>&header_, &fields_;
  std::string where_;
};

const std::vector<std::string>& known_columns() {
  static const std::vector<std::string> names = [] {
    std::vector<std::string> n;
    for (int a = 0; a < DIM; ++a)
      for (const char* unit : {"_um", "_W0"}) n.push_back(std::string(1, "xyz"[a]) + unit);
    n.insert(n.end(), {"radius_um", "radius_W0", "nucleation_time_s", "nucleation_time_tau0", "held"});
    if (DIM == 2) n.push_back("angle_deg");
    if (DIM == 3) n.insert(n.end(), {"euler1_deg", "euler2_deg", "euler3_deg"});
    return n;
  }();
  return names;
}

SeedOptions seed_of(const Row& row, const Scales& scales) {
  SeedOptions s;
  RealVec um{}, w0{};
  int in_um = 0, in_w0 = 0;
  for (int a = 0; a < DIM; ++a) {
    const std::string axis(1, "xyz"[a]);
    if (const auto x = row.number(axis + "_um")) um[a] = *x, ++in_um;
    if (const auto x = row.number(axis + "_W0")) w0[a] = *x, ++in_w0;
  }
  if (in_um + in_w0 != DIM || (in_um != 0 && in_w0 != 0))
    row.fail("columns for all coordinates of the centre, in _um or in _W0", fmt::format("{} in um, {} in W0", in_um, in_w0));
  (in_um > 0 ? s.position_um : s.position_w0) = in_um > 0 ? um : w0;
  s.radius_um = row.number("radius_um");
  s.radius_w0 = row.number("radius_W0");
  if (s.radius_um.has_value() == s.radius_w0.has_value())
    row.fail("exactly one of the columns radius_um and radius_W0", s.radius_um ? "both" : "neither");
  if (const double r = s.radius_um ? *s.radius_um : *s.radius_w0; r <= 0) row.fail("a radius > 0", fmt::format("{}", r));
  if (const auto angle = row.number("angle_deg")) s.angle_deg = *angle;
  for (std::size_t i = 0; i < 3; ++i)
    if (const auto angle = row.number(fmt::format("euler{}_deg", i + 1))) s.euler_deg[i] = *angle;
  s.nucleation_time_s = row.number("nucleation_time_s");
  s.nucleation_time_tau0 = row.number("nucleation_time_tau0");
  if (s.nucleation_time_s && s.nucleation_time_tau0) row.fail("a nucleation time in s or in tau0", "both");
  if (s.nucleation_time_s.value_or(0) < 0 || s.nucleation_time_tau0.value_or(0) < 0) row.fail("a nucleation time >= 0", "less");
  if (const double time = s.nucleation_time_s.value_or(0); !std::isfinite(time / scales.tau0_s))
    row.fail(fmt::format("a nucleation time that is finite in tau0 = {:.3g} s", scales.tau0_s), fmt::format("{:g} s", time));
  if (const auto held = row.number("held")) {
    if (*held != 0 && *held != 1) row.fail("0 or 1 in column held", fmt::format("{}", *held));
    s.held = *held == 1;
  }
  return s;
}

// Places that keep a distance, in a grid of cells of at least that size: a search looks at a cell and those around it.
class Places {
 public:
  Places(const amr::MeshShape& shape, double apart, int expected) : shape_(shape), apart_(apart), periodic_(shape.periodic()) {
    const double most = std::ceil(std::pow(4.0 * expected, 1.0 / DIM));  // cells along an axis
    int count = 1;
    for (int a = 0; a < DIM; ++a) {
      const double extent = shape.hi()[a] - shape.lo[a];
      cells_[a] = static_cast<int>(std::clamp(std::floor(extent / std::max(apart, 1e-300)), 1.0, most));
      width_[a] = extent / cells_[a];
      count *= cells_[a];
    }
    lists_.resize(static_cast<std::size_t>(count));
  }

  bool near(const RealVec& x) const {
    const IntVec home = cell(x);
    bool found = false;
    amr::for_each_cell(filled(-1), filled(3), [&](const IntVec& step) {
      IntVec c = home;
      for (int a = 0; a < DIM; ++a) {
        c[a] += step[a];
        if (periodic_[a]) c[a] = (c[a] + cells_[a]) % cells_[a];
        if (c[a] < 0 || c[a] >= cells_[a]) return;
      }
      for (const RealVec& other : lists_[list(c)]) {
        const RealVec way = shape_.way(x, other);
        double square = 0;
        for (const double r : way) square += r * r;
        found = found || square < apart_ * apart_;
      }
    });
    return found;
  }
  void add(const RealVec& x) { lists_[list(cell(x))].push_back(x); }

 private:
  IntVec cell(const RealVec& x) const {
    IntVec c{};
    for (int a = 0; a < DIM; ++a) c[a] = std::clamp(static_cast<int>((x[a] - shape_.lo[a]) / width_[a]), 0, cells_[a] - 1);
    return c;
  }
  std::size_t list(const IntVec& c) const {
    std::size_t n = 0;
    for (int a = DIM - 1; a >= 0; --a) n = n * static_cast<std::size_t>(cells_[a]) + static_cast<std::size_t>(c[a]);
    return n;
  }

  const amr::MeshShape& shape_;
  double apart_;
  Array<bool> periodic_;
  IntVec cells_{};
  RealVec width_{};
  std::vector<std::vector<RealVec>> lists_;
};

}  // namespace

void SeedingOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("seeds", "more crystals beside [[seed]]: at random, or from a file");
  t.integer("count", count).range(0, 10'000).doc("crystals at random places, with random orientations");
  t.integer("generator", generator).doc("number that selects the places; the same on any number of ranks");
  t.real("radius_um", radius_um).unit("um").above(0).doc("radius at phi = 0 of those at random; or radius_W0");
  t.real("radius_W0", radius_w0).unit("W0").above(0).doc("radius at phi = 0 of those at random");
  t.real("clearance_W0", clearance_w0).unit("W0").at_least(0).doc("least distance from surface to surface, and to sides that are not periodic");
  t.reals("region_lo", region_lo).range(0, 1).doc("low corner of the part of the box that they lie in, in parts of its sides");
  t.reals("region_hi", region_hi).range(0, 1).doc("high corner of it");
  t.real("last_nucleation_time_s", last_time_s).unit("s").at_least(0).doc("they appear at random times up to this one; none: all at the start");
  t.real("last_nucleation_time_tau0", last_time_tau0).unit("tau0").at_least(0).doc("the same in units of tau0");
  t.text("file", file).doc("CSV with a header: x_um, y_um[, z_um], radius_um, and as wanted angle_deg or euler1_deg, euler2_deg, euler3_deg, "
                           "nucleation_time_s, held; or with _W0 and _tau0; relative to the input file");
  schema.check({"seeds"}, [this](io::Checks& checks) {
    if (!checks.has_table("seeds")) return;
    if (count == 0 && file.empty()) checks.fail("seeds", "count > 0, or file", "neither");
    if (count > 0 && radius_um.has_value() == radius_w0.has_value())
      checks.fail("seeds", "exactly one of radius_um and radius_W0", radius_um ? "both" : "neither");
    if (last_time_s && last_time_tau0)
      checks.fail("seeds", "at most one of last_nucleation_time_s and last_nucleation_time_tau0", "both");
    for (int a = 0; a < DIM; ++a)
      if (region_lo[a] > region_hi[a]) {
        checks.fail("seeds.region_lo", "no number above that of region_hi");
        break;
      }
  });
}

std::vector<SeedOptions> SeedingOptions::at_random(const amr::MeshShape& shape, const Scales& scales) const {
  std::vector<SeedOptions> seeds;
  if (count == 0) return seeds;
  const double radius = radius_w0 ? *radius_w0 : *radius_um / scales.w0_um;
  const double apart = 2 * radius + clearance_w0, from_side = radius + clearance_w0;
  RealVec lo{}, hi{};
  const RealVec corner = shape.hi();
  for (int a = 0; a < DIM; ++a) {
    const double extent = corner[a] - shape.lo[a], margin = shape.periodic()[a] ? 0.0 : from_side;
    lo[a] = std::max(shape.lo[a] + region_lo[a] * extent, shape.lo[a] + margin);
    hi[a] = std::min(shape.lo[a] + region_hi[a] * extent, corner[a] - margin);
    if (lo[a] > hi[a]) throw SeedingProblem("seeds.region_lo", "a region wider than the seeds and their clearance", "less");
  }
  const auto draw = [&](std::uint64_t seed, std::uint64_t attempt, std::uint64_t what) {
    return unit(mix(mix(mix(mix(static_cast<std::uint64_t>(generator)) ^ seed) ^ attempt) ^ what));
  };
  constexpr int ATTEMPTS = 10'000;
  Places taken(shape, apart, count);
  for (int i = 0; i < count; ++i) {
    const auto number = static_cast<std::uint64_t>(i);
    SeedOptions s;
    for (int attempt = 0; attempt < ATTEMPTS && !s.position_w0; ++attempt) {
      RealVec x{};
      for (int a = 0; a < DIM; ++a)
        x[a] = lo[a] + (hi[a] - lo[a]) * draw(number, static_cast<std::uint64_t>(attempt), static_cast<std::uint64_t>(a));
      if (taken.near(x)) continue;
      taken.add(x);
      s.position_w0 = x;
    }
    if (!s.position_w0)
      throw SeedingProblem("seeds.count", fmt::format("seeds that have room: {} found none after {} attempts", i + 1, ATTEMPTS),
                           fmt::format("{}", count));
    s.radius_w0 = radius;
    const auto turn = [&](int k) { return draw(number, ATTEMPTS, static_cast<std::uint64_t>(k)); };
    if (DIM == 2) {
      s.angle_deg = 90 * turn(0);
    } else {  // uniform over all rotations
      s.euler_deg = {360 * turn(0), std::acos(1 - 2 * turn(1)) * 180 / std::numbers::pi, 360 * turn(2)};
    }
    if (last_time_s) s.nucleation_time_s = *last_time_s * turn(3);
    if (last_time_tau0) s.nucleation_time_tau0 = *last_time_tau0 * turn(3);
    seeds.push_back(s);
  }
  return seeds;
}

std::vector<SeedOptions> SeedingOptions::from_file(const std::string& folder, const Scales& scales) const {
  std::vector<SeedOptions> seeds;
  if (file.empty()) return seeds;
  const std::filesystem::path path = std::filesystem::path(folder) / file;  // an absolute one stays
  std::ifstream in(path);
  if (!in || std::filesystem::is_directory(path)) throw SeedingProblem("seeds.file", "a file that can be read", path.string());
  std::vector<std::string> header;
  std::string line;
  for (int number = 1; std::getline(in, line); ++number) {
    line = trimmed(line);
    if (line.empty() || line[0] == '#') continue;
    const std::vector<std::string> fields = fields_of(line);
    const std::string where = fmt::format("{}:{}", path.string(), number);
    if (header.empty()) {
      header = fields;
      for (std::size_t i = 0; i < header.size(); ++i)
        if (std::ranges::find(known_columns(), header[i]) == known_columns().end() ||
            std::find(header.begin(), header.begin() + static_cast<std::ptrdiff_t>(i), header[i]) != header.begin() + static_cast<std::ptrdiff_t>(i))
          throw SeedingProblem("seeds.file", fmt::format("{}: columns among {}, each once", where, fmt::join(known_columns(), ", ")),
                               header[i]);
      continue;
    }
    if (fields.size() != header.size())
      throw SeedingProblem("seeds.file", fmt::format("{}: {} fields, as in the header", where, header.size()),
                           fmt::format("{}", fields.size()));
    seeds.push_back(seed_of(Row(header, fields, where), scales));
  }
  if (header.empty()) throw SeedingProblem("seeds.file", path.string() + ": a header line", "an empty file");
  return seeds;
}

}  // namespace dendrift::physics

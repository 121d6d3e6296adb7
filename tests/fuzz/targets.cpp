#include "targets.hpp"

#include <hdf5.h>
#include <mpi.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <span>
#include <stdexcept>

#include "amr/field.hpp"
#include "io/checkpoint.hpp"
#include "io/crc32.hpp"
#include "io/seal.hpp"
#include "physics/modules.hpp"
#include "settings.hpp"
#include "simulation.hpp"

namespace dendrift::fuzz {

namespace {

std::string cause_of(const io::InputError& error) {
  const io::InputIssue& first = error.issues().front();
  if (first.key.empty()) return "not TOML, or not text";
  if (first.expected.starts_with("a known") || first.expected.starts_with("a table (keys")) return "unknown key or table";
  return first.found.starts_with("nothing") ? "missing key or table" : "wrong type, value or combination";
}

// Causes are counted: numbers and names of fields do not matter.
std::string cause_of(const io::OutputError& error) {
  const std::string& reason = error.reason();
  if (reason.starts_with("HDF5")) return "HDF5 reports an error";
  for (const char* common : {"has another checksum", "not as long as", "this is not a checkpoint", "format", "does not hold", "truncated"})
    if (reason.find(common) != std::string::npos) return common;
  return reason.substr(0, reason.find_first_of("0123456789"));
}

void require(bool good, const char* what) {
  if (!good) throw std::logic_error(std::string("accepted, although ") + what);
}

bool positive(double x) { return std::isfinite(x) && x > 0; }

void require_usable(const Settings& s) {
  const physics::Scales& a = s.scales;
  for (const double x : {a.k, a.supersaturation, a.c_l_wt, a.d0_um, a.w0_um, a.lambda, a.diffusivity, a.tau0_s, a.viscosity})
    require(positive(x), "a scale is not a positive number");
  require(std::isfinite(s.end_time) && s.end_time >= 0, "the end time is not finite");
  require(std::isfinite(s.plot_interval) && std::isfinite(s.diagnostics_interval), "an output interval is not finite");
  require(positive(s.shape.root_dx) && volume(s.shape.root_blocks) <= MOST_ROOT_BLOCKS, "the mesh makes no sense");
  for (const physics::Seed& seed : s.crystals) {
    require(positive(seed.radius), "the radius of a seed is not a positive number");
    require(std::isfinite(seed.nucleation_time), "the time of a seed is not finite");
    for (const double x : seed.position) require(std::isfinite(x), "the place of a seed is not finite");
  }
}

// Removed first: of a damaged file HDF5 may keep something open, and it knows files by their inodes.
void write(const std::string& path, const std::string& bytes) {
  std::filesystem::remove(path);
  std::ofstream(path, std::ios::binary).write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

std::string vec(double x, double rest) {
  std::string s = "[" + std::to_string(x);
  for (int a = 1; a < DIM; ++a) s += ", " + std::to_string(rest);
  return s + "]";
}

// Two crystals that turn and drift, so that all modules keep something in a checkpoint.
std::string scene_text() {
  const std::string roots = DIM == 2 ? "[2, 1]" : "[2, 1, 1]";
  return "[run]\nend_time_tau0 = 1e6\n[mesh]\ndim = " + std::to_string(DIM) + "\nsize_W0 = " + vec(32, 16) + "\nroot_blocks = " + roots +
         "\nlevels = 2\nblock_cells = 8\n[flow]\nvelocity_W0_tau0 = " + vec(0.01, 0.02) + "\n[[seed]]\nposition_W0 = " + vec(8, 8) +
         "\nradius_W0 = 4\n[[seed]]\nposition_W0 = " + vec(24, 8) + "\nradius_W0 = 4\n" +
         (DIM == 2 ? "angle_deg = 20\n" : "euler_deg = [10, 20, 30]\n");
}

std::string flushed(const io::Handle& file, const std::string& path) {
  H5Fflush(file.id(), H5F_SCOPE_GLOBAL);
  return content_of(path);
}

// Dimensions of attributes and datasets that are often forgotten.
const std::vector<hsize_t>& odd_lengths() {
  static const std::vector<hsize_t> all{0, 1, 2, 3, 7, 100, 5000};
  return all;
}

}  // namespace

std::string content_of(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

Verdict try_input(const std::string& text) {
  const auto settings = std::make_unique<Settings>();
  try {
    settings->parse_text(text, "mutant.toml", {});
  } catch (const io::InputError& refused) {
    if (refused.issues().empty()) throw std::logic_error("refused without a word");
    return {false, cause_of(refused)};
  }
  require_usable(*settings);
  amr::FieldTable fields;
  for (const auto& m : physics::make_modules(*settings, settings->crystals)) m->declare(fields);
  const std::string resolved = settings->schema.resolved_toml();
  const auto again = std::make_unique<Settings>();
  again->parse_text(resolved, "resolved.toml", {});
  require(again->schema.resolved_toml() == resolved, "the resolved input reads back as another one");
  require(settings->schema.changes_since(resolved).empty(), "the input differs from its own resolved one");
  return {true, ""};
}

// ---- checkpoints ----

struct Checkpoints::Scene {
  Settings settings;
};

Checkpoints::Checkpoints(std::string folder)
    : folder_(std::move(folder)), path_(folder_ + "/mutant.h5"), scene_(std::make_unique<Scene>()) {
  scene_->settings.parse_text(scene_text(), "scene.toml", {});
  Simulation simulation(scene_->settings, MPI_COMM_SELF);
  for (int i = 0; i < 2; ++i) simulation.step(0.01);
  simulation.write_checkpoint(path_);
  good_ = content_of(path_);
  room_ = good_.find("HDF");
  room_ -= 1;  // \211HDF
  const io::File file = io::File::open(path_, io::Access::read);
  const auto note = [](hid_t group, const char* name, const H5L_info_t*, void* list) -> herr_t {
    const hid_t d = H5Dopen2(group, name, H5P_DEFAULT);
    if (d < 0) return 0;  // a group
    static_cast<std::vector<Item>*>(list)->push_back({name, io::Dataset(d, "").range()});
    return 0;
  };
  H5Lvisit(file.id(), H5_INDEX_NAME, H5_ITER_INC, note, &items_);
  for (const Item& item : items_)
    if (item.name.starts_with("fields/")) values_.push_back(item.range);
  std::ranges::sort(values_, {}, &io::FileRange::offset);
}

Checkpoints::~Checkpoints() = default;

std::string Checkpoints::mutant(const std::string& from, bool with_bookkeeping, Chance& chance) {
  switch (chance.below(with_bookkeeping ? 4 : 3)) {
    case 3: return mutate_bytes(from, room_, chance);
    case 0: return change_attribute(good_, chance);  // HDF5 may crash on another
    default: return change_values(from, chance);
  }
}

std::string Checkpoints::change_values(std::string bytes, Chance& chance) const {
  for (std::size_t n = 1 + chance.below(3); n > 0; --n) {
    const Item& item = chance.of(items_);
    if (item.range.bytes < 8 || item.range.offset + item.range.bytes > bytes.size()) continue;
    if (item.name == "input" || item.name == "origin") {
      std::string text = mutate_input(bytes.substr(item.range.offset, item.range.bytes), {scene_text()}, chance);
      text.resize(item.range.bytes, '\n');
      bytes.replace(item.range.offset, text.size(), text);
      continue;
    }
    const std::size_t size = item.name.starts_with("fields/") ? 8 : 4;
    std::size_t at = item.range.offset + size * chance.below(item.range.bytes / size);
    for (std::size_t run = chance.one_in(4) ? 1 + chance.below(64) : 1; run > 0 && at + size <= item.range.offset + item.range.bytes; --run, at += size) {
      const double number = chance.of(odd_numbers());
      const auto integer = static_cast<std::int32_t>(chance.one_in(2) ? chance.below(9) - 3 : std::size_t{0x7FFFFFFF} + chance.below(3));
      std::memcpy(bytes.data() + at, size == 8 ? static_cast<const void*>(&number) : &integer, size);
    }
  }
  mend_checksums(bytes);
  return bytes;
}

// Otherwise only the checksums would be tried.
void Checkpoints::mend_checksums(std::string& bytes) const {
  for (const Item& item : items_) {
    if (!item.name.starts_with("fields/")) continue;
    const auto sums = std::ranges::find(items_, "checksums/" + item.name.substr(7), &Item::name);
    if (sums == items_.end() || item.range.offset + item.range.bytes > bytes.size()) continue;
    if (sums->range.offset + sums->range.bytes > bytes.size()) continue;
    const std::size_t leaves = sums->range.bytes / 4, each = item.range.bytes / leaves;
    for (std::size_t i = 0; i < leaves; ++i) {
      const std::uint32_t sum = io::crc32(std::as_bytes(std::span(bytes).subspan(item.range.offset + i * each, each)));
      std::memcpy(bytes.data() + sums->range.offset + 4 * i, &sum, 4);
    }
  }
}

std::string Checkpoints::change_attribute(const std::string& bytes, Chance& chance) const {
  const std::string path = folder_ + "/edited.h5";
  write(path, bytes);
  H5Eset_auto2(H5E_DEFAULT, nullptr, nullptr);
  const io::Handle file(H5Fopen(path.c_str(), H5F_ACC_RDWR, H5P_DEFAULT), H5Fclose);
  if (file.id() < 0) return bytes;
  if (chance.one_in(6)) {  // a dataset or a group gone, or of another shape
    static const std::vector<std::string> names{"leaves", "input", "origin", "numbers", "fields", "checksums"};
    const std::string name = chance.one_in(2) ? chance.of(names) : chance.of(items_).name;
    H5Ldelete(file.id(), name.c_str(), H5P_DEFAULT);
    const hsize_t extent[2] = {chance.of(odd_lengths()) + 1, 2};
    const io::Handle space(H5Screate_simple(chance.one_in(3) ? 2 : 1, extent, nullptr), H5Sclose);
    const std::vector<hid_t> types{H5T_NATIVE_INT, H5T_NATIVE_DOUBLE, H5T_NATIVE_UINT8, H5T_C_S1};
    if (chance.one_in(2)) io::Handle(H5Dcreate2(file.id(), name.c_str(), chance.of(types), space.id(), H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT), H5Dclose);
  } else {
    const io::Handle owner(H5Gopen2(file.id(), chance.one_in(4) ? "/" : "numbers", H5P_DEFAULT), H5Gclose);
    H5O_info_t info;
    char name[256] = "new";
    if (owner.id() >= 0 && H5Oget_info1(owner.id(), &info) >= 0 && info.num_attrs > 0)
      H5Aget_name_by_idx(owner.id(), ".", H5_INDEX_NAME, H5_ITER_INC, chance.below(info.num_attrs), name, sizeof name, H5P_DEFAULT);
    io::Handle old(H5Aopen(owner.id(), name, H5P_DEFAULT), H5Aclose);
    const io::Handle own_space(H5Aget_space(old.id()), H5Sclose);
    std::vector<double> values(static_cast<std::size_t>(std::max<hssize_t>(1, H5Sget_simple_extent_npoints(own_space.id()))));
    H5Aread(old.id(), H5T_NATIVE_DOUBLE, values.data());
    old.close();
    H5Adelete(owner.id(), name);
    const bool same_length = !chance.one_in(4);
    if (!same_length) values.resize(static_cast<std::size_t>(chance.of(odd_lengths())));
    for (std::size_t n = 1 + chance.below(3); n > 0 && !values.empty(); --n) values[chance.below(values.size())] = chance.of(odd_numbers());
    const hsize_t count = values.size();
    const io::Handle space(same_length && values.size() == 1 ? H5Screate(H5S_SCALAR) : H5Screate_simple(1, &count, nullptr), H5Sclose);
    const std::vector<hid_t> types{H5T_NATIVE_DOUBLE, H5T_NATIVE_DOUBLE, H5T_NATIVE_DOUBLE, H5T_NATIVE_INT64, H5T_NATIVE_INT, H5T_C_S1};
    if (chance.one_in(8)) return flushed(file, path);  // gone
    const io::Handle fresh(H5Acreate2(owner.id(), name, chance.of(types), space.id(), H5P_DEFAULT, H5P_DEFAULT), H5Aclose);
    if (count > 0) H5Awrite(fresh.id(), H5T_NATIVE_DOUBLE, values.data());
  }
  return flushed(file, path);
}

Verdict Checkpoints::attempt(const std::string& bytes, bool sealed) {
  write(path_, bytes);
  if (sealed && bytes.size() > room_) {
    std::vector<io::FileRange> values;
    for (const io::FileRange& v : values_)
      if (v.offset + v.bytes <= bytes.size()) values.push_back(v);
    io::write_seal(path_, room_, io::CHECKPOINT_FORMAT, values);
  }
  try {
    const Simulation simulation(scene_->settings, MPI_COMM_SELF, path_, true);
    return {true, ""};
  } catch (const io::OutputError& refused) {
    return {false, cause_of(refused)};
  } catch (const io::InputError& refused) {
    return {false, cause_of(refused)};
  }
}

}  // namespace dendrift::fuzz

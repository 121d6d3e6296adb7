#include "io/plotfile.hpp"

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <fstream>
#include <limits>
#include <optional>
#include <regex>
#include <stdexcept>
#include <system_error>

#include "io/hdf5.hpp"

namespace dendrift::io {
namespace {

/// Readers search a mapping's blocks one after the other, so that the time to open a virtual dataset grows
/// with the square of the blocks in a mapping.
constexpr std::size_t kBlocksPerMapping = 1024;
/// vtkDataSetAttributes::REFINEDCELL: the cell is not drawn, finer ones cover it.
constexpr std::uint8_t kRefinedCell = 32;
constexpr const char* kChomboData = "data:datatype=0";

std::size_t cells_per_block(const PlotHeader& header) {
  std::size_t cells = 1;
  for (int d = 0; d < DIM; ++d) cells *= static_cast<std::size_t>(header.block_cells);
  return cells;
}

std::size_t values_per_block(const PlotHeader& header) {
  return cells_per_block(header) * header.fields.size();
}

std::string level_path(std::size_t level) { return "/level_" + std::to_string(level); }

/// {"lo_i", "lo_j", ...}: the member names of Chombo's index types.
void add_members(std::vector<std::string>& names, const std::string& prefix, const char* axes = "ijk") {
  for (int d = 0; d < DIM; ++d) names.push_back(prefix + axes[d]);
}

Type box_type() {
  std::vector<std::string> names;
  add_members(names, "lo_");
  add_members(names, "hi_");
  return Type::record<std::int32_t>(names);
}

Type intvect_type() {
  std::vector<std::string> names;
  add_members(names, "intvect");
  return Type::record<std::int32_t>(names);
}

Type realvect_type() {
  std::vector<std::string> names;
  add_members(names, "", "xyz");
  return Type::record<double>(names);
}

// ---- what is known without the values -----------------------------------------------------------

void require(bool condition, const char* what) {
  if (!condition) throw std::invalid_argument(std::string("plotfile: ") + what);
}

void check_level(const PlotLevel& level, int block_cells, int ranks) {
  require(!level.blocks.empty(), "a level has no blocks");
  require(level.owner.size() == level.blocks.size() && level.refined.size() == level.blocks.size(),
          "a level's blocks, owners and refinement flags differ in number");
  const auto [lowest, highest] = std::minmax_element(level.owner.begin(), level.owner.end());
  require(*lowest >= 0 && *highest < ranks, "a block's owner is not a rank of the communicator");
  constexpr std::uint8_t all = (1U << (1U << DIM)) - 1U;
  const auto by_octant = [](std::uint8_t bits) { return bits != 0 && bits != all; };
  require(block_cells % 2 == 0 || std::none_of(level.refined.begin(), level.refined.end(), by_octant),
          "blocks of odd size cannot be refined by octants");
}

void check_header(const PlotHeader& header, MPI_Comm comm) {
  int ranks = 0;
  MPI_Comm_size(comm, &ranks);
  require(header.block_cells > 0, "block_cells is not positive");
  require(!header.fields.empty() && !header.levels.empty(), "there are no fields or no levels");
  for (const std::string& field : header.fields) {
    require(!field.empty() && field.find_first_of("/.") == std::string::npos,
            "a field's name is empty or has / or .");
  }
  for (const PlotLevel& level : header.levels) check_level(level, header.block_cells, ranks);
}

void write_root_attributes(const File& file, const PlotHeader& header) {
  const auto levels = static_cast<std::int32_t>(header.levels.size());
  file.write_attribute("filetype", "VanillaAMRFileType");
  file.write_attribute("num_levels", levels);
  file.write_attribute("max_level", levels - 1);
  file.write_attribute("num_components", static_cast<std::int32_t>(header.fields.size()));
  // Chombo's readers want 32 bits; a longer run shows the last step they can name.
  constexpr std::int64_t last = std::numeric_limits<std::int32_t>::max();
  file.write_attribute("iteration", static_cast<std::int32_t>(std::min(header.step, last)));
  file.write_attribute("time", header.time_s);
  for (std::size_t f = 0; f < header.fields.size(); ++f) {
    file.write_attribute("component_" + std::to_string(f), header.fields[f]);
  }
  file.write_attribute("prob_lo", realvect_type(), Dataspace::scalar(), header.origin_um.data());
  const Group global = file.create_group("Chombo_global");
  global.write_attribute("SpaceDim", std::int32_t{DIM});
  global.write_attribute("testReal", 0.0);
}

void write_level_attributes(const Group& group, const PlotHeader& header, std::size_t level) {
  group.write_attribute("dx", header.dx0_um / static_cast<double>(1U << level));
  group.write_attribute("dt", 0.0);
  group.write_attribute("time", header.time_s);
  group.write_attribute("ref_ratio", std::int32_t{2});
  for (int d = 0; d < DIM; ++d) {
    group.write_attribute("is_periodic_" + std::to_string(d), std::int32_t{header.periodic[d]});
  }
  std::array<std::int32_t, 2 * DIM> domain{};  // inclusive
  for (int d = 0; d < DIM; ++d) domain[DIM + d] = ((header.root_blocks[d] * header.block_cells) << level) - 1;
  group.write_attribute("prob_domain", box_type(), Dataspace::scalar(), domain.data());
  const Group data = group.create_group("data_attributes");
  data.write_attribute("comps", static_cast<std::int32_t>(header.fields.size()));
  data.write_attribute("objectType", "FArrayBox");
  const std::array<std::int32_t, DIM> none{};
  data.write_attribute("ghost", intvect_type(), Dataspace::scalar(), none.data());
  data.write_attribute("outputGhost", intvect_type(), Dataspace::scalar(), none.data());
}

void write_chombo_tables(const Group& group, const PlotHeader& header, std::size_t level) {
  const std::vector<IntVec>& blocks = header.levels[level].blocks;
  const std::vector<std::int32_t>& owner = header.levels[level].owner;
  const std::size_t count = blocks.size();
  const Dataspace per_block = Dataspace::simple(count);
  const Type box = box_type();
  const Dataset boxes = group.create_dataset("boxes", box, per_block);
  const Dataset processors = group.create_dataset("Processors", Type::of<std::int32_t>(), per_block);
  const Dataspace ends = Dataspace::simple(count + 1);
  const Dataset offsets = group.create_dataset("data:offsets=0", Type::of<std::int64_t>(), ends);
  std::vector<std::int32_t> corners;
  for (const IntVec& block : blocks) {
    for (const int coordinate : block) corners.push_back(header.block_cells * coordinate);
    for (const int coordinate : block) corners.push_back(header.block_cells * (coordinate + 1) - 1);
  }
  const auto values = static_cast<std::int64_t>(values_per_block(header));
  std::vector<std::int64_t> offset(count + 1, 0);
  for (std::size_t b = 0; b < count; ++b) offset[b + 1] = offset[b] + values;
  boxes.write(box, corners.data(), per_block, Transfer::independent);
  processors.write(std::span<const std::int32_t>(owner), per_block, Transfer::independent);
  offsets.write(std::span<const std::int64_t>(offset), ends, Transfer::independent);
}

void write_vtk_boxes(const Group& group, const PlotHeader& header, std::size_t level) {
  const std::vector<IntVec>& blocks = header.levels[level].blocks;
  const std::array<hsize_t, 2> extent{blocks.size(), 6};
  const Dataspace space = Dataspace::simple(extent);
  const Dataset boxes = group.create_dataset("AMRBox", Type::of<std::int32_t>(), space);
  std::vector<std::int32_t> corners;
  for (const IntVec& block : blocks) {
    for (int d = 0; d < 3; ++d) {
      corners.push_back(d < DIM ? header.block_cells * block[d] : 0);
      corners.push_back(d < DIM ? header.block_cells * (block[d] + 1) - 1 : 0);
    }
  }
  boxes.write(std::span<const std::int32_t>(corners), space, Transfer::independent);
}

/// Where VTK's dataset of one field lies in Chombo's, which has all fields of a block after each other.
std::vector<Mapping> field_mappings(const PlotHeader& header, std::size_t level, std::size_t field) {
  const std::size_t blocks = header.levels[level].blocks.size();
  const std::size_t cells = cells_per_block(header);
  const std::size_t stride = values_per_block(header);
  std::vector<Mapping> mappings;
  for (std::size_t first = 0; first < blocks; first += kBlocksPerMapping) {
    const std::size_t count = std::min(kBlocksPerMapping, blocks - first);
    Dataspace target = Dataspace::simple(blocks * cells);
    target.select_runs(first * cells, count * cells, 1, count * cells);
    Dataspace source = Dataspace::simple(blocks * stride);
    source.select_runs(first * stride + field * cells, stride, count, cells);
    mappings.push_back({std::move(target), level_path(level) + "/" + kChomboData, std::move(source)});
  }
  return mappings;
}

void create_vtk_level(const Group& root, const PlotHeader& header, std::size_t level) {
  const Group group = root.create_group("Level" + std::to_string(level));
  const double dx = header.dx0_um / static_cast<double>(1U << level);
  // In the plane the thickness of a cell must not depend on its level: ParaView shows one slab.
  const std::array<double, 3> spacing{dx, dx, DIM == 3 ? dx : header.dx0_um};
  group.write_attribute("Spacing", std::span<const double>(spacing));
  write_vtk_boxes(group, header, level);
  (void)group.create_group("PointData");
  (void)group.create_group("FieldData");
  const Group cells = group.create_group("CellData");
  const Dataspace space = Dataspace::simple(header.levels[level].blocks.size() * cells_per_block(header));
  for (std::size_t f = 0; f < header.fields.size(); ++f) {
    cells.create_virtual_dataset(header.fields[f], Type::of<double>(), space,
                                 field_mappings(header, level, f));
  }
  (void)cells.create_dataset("vtkGhostType", Type::of<std::uint8_t>(), space);
}

void create_chombo_level(const File& file, const PlotHeader& header, std::size_t level) {
  const Group group = file.create_group("level_" + std::to_string(level));
  write_level_attributes(group, header, level);
  write_chombo_tables(group, header, level);
  const Dataspace space = Dataspace::simple(header.levels[level].blocks.size() * values_per_block(header));
  (void)group.create_dataset(kChomboData, Type::of<double>(), space);
}

Group create_vtk_root(const File& file, const PlotHeader& header) {
  Group root = file.create_group("VTKHDF");
  // ParaView compares the bytes: exactly these, of fixed length.
  root.write_attribute("Type", "OverlappingAMR");
  root.write_attribute("GridDescription", "XYZ_GRID");
  const std::array<std::int64_t, 2> version{1, 0};
  root.write_attribute("Version", std::span<const std::int64_t>(version));
  std::array<double, 3> origin{};
  std::copy(header.origin_um.begin(), header.origin_um.end(), origin.begin());
  root.write_attribute("Origin", std::span<const double>(origin));
  return root;
}

/// At least the size of the file. HDF5 lists every block of a mapping with 8 or 16 bytes.
std::uint64_t bytes_needed(const PlotHeader& header) {
  constexpr std::uint64_t per_object = 4096;
  constexpr std::uint64_t per_table_entry = 4 * 2 * DIM + 4 + 8 + 4 * 6;
  const std::uint64_t fields = header.fields.size();
  std::uint64_t bytes = (8 + fields) * per_object;
  for (const PlotLevel& level : header.levels) {
    const std::uint64_t blocks = level.blocks.size();
    bytes += blocks * (8 * values_per_block(header) + cells_per_block(header));
    bytes += blocks * (per_table_entry + 16 * fields);
    bytes += (16 + fields * (blocks / kBlocksPerMapping + 2)) * per_object;
  }
  return bytes;
}

/// Everything but the values: their datasets exist and have their places in the file. Called by one rank.
void write_layout(const std::string& path, const PlotHeader& header) {
  File file = File::create(path);
  reserve_space(path, bytes_needed(header));
  {
    write_root_attributes(file, header);
    const Group vtk = create_vtk_root(file, header);
    for (std::size_t level = 0; level < header.levels.size(); ++level) {
      create_chombo_level(file, header, level);
      create_vtk_level(vtk, header, level);
    }
  }
  file.close();
  release_excess_space(path);
}

// ---- the values ---------------------------------------------------------------------------------

/// VTK's mark of every cell of a block; `refined` as in PlotLevel.
void mark_refined_cells(std::uint8_t refined, std::size_t n, std::span<std::uint8_t> out) {
  for (std::size_t cell = 0; cell < out.size(); ++cell) {
    std::size_t rest = cell;
    unsigned octant = 0;
    for (unsigned d = 0; d < DIM; ++d, rest /= n) octant |= (2 * (rest % n) >= n ? 1U : 0U) << d;
    out[cell] = (refined >> octant & 1U) != 0 ? kRefinedCell : std::uint8_t{0};
  }
}

/// The datasets of one level that receive values from all ranks.
struct LevelData {
  Dataset values;  ///< f64, [block][component][cells]
  Dataset marks;   ///< u8, [block][cells]
};

std::vector<LevelData> open_levels(const File& file, std::size_t count) {
  std::vector<LevelData> levels;
  for (std::size_t level = 0; level < count; ++level) {
    const std::string number = std::to_string(level);
    levels.push_back({file.open_dataset(level_path(level) + "/" + kChomboData),
                      file.open_dataset("/VTKHDF/Level" + number + "/CellData/vtkGhostType")});
  }
  return levels;
}

void write_values(const std::vector<LevelData>& data, const PlotHeader& header, const PlotFill& fill,
                  MPI_Comm comm) {
  const auto n = static_cast<std::size_t>(header.block_cells);
  SharedFailure failure;
  for (std::size_t lev = 0; lev < data.size(); ++lev) {
    const PlotLevel& level = header.levels[lev];
    const Share share = share_of(level.owner, comm);
    const auto values = [&](std::size_t b, std::span<double> out) { fill(static_cast<int>(lev), b, out); };
    const auto marks = [&](std::size_t b, std::span<std::uint8_t> out) {
      mark_refined_cells(level.refined[b], n, out);
    };
    write_items<double>(data[lev].values, share, values_per_block(header), failure, values);
    write_items<std::uint8_t>(data[lev].marks, share, cells_per_block(header), failure, marks);
  }
  failure.agree(comm);
}

void write_part(const std::string& part, const PlotHeader& header, const PlotFill& fill, MPI_Comm comm) {
  int rank = 0;
  MPI_Comm_rank(comm, &rank);
  SharedFailure failure;
  if (rank == 0) failure.attempt(part, "lay out the file", [&] { write_layout(part, header); });
  failure.agree(comm);
  std::optional<File> file;
  std::vector<LevelData> data;
  failure.attempt(part, "open the file", [&] {
    file = File::open(part, Access::write_values, comm);
    data = open_levels(*file, header.levels.size());
  });
  failure.agree(comm);
  write_values(data, header, fill, comm);
  data.clear();
  failure.attempt(part, "write out the file", [&] { file->flush(); });
  failure.agree(comm);
  failure.attempt(part, "close the file", [&] { file->close(); });
  failure.agree(comm);
}

// ---- the time series ----------------------------------------------------------------------------

struct SeriesEntry {
  std::string name;  // as it stands between the quotes of JSON
  double time;
};

std::string json_text(const std::string& text) {
  std::string escaped;
  for (const char c : text) {
    if (c == '"' || c == '\\') escaped += '\\';
    escaped += c;
  }
  return escaped;
}

/// The entries of a list written by append_series, one to a line; none if there is no such file.
std::vector<SeriesEntry> read_series(const std::string& path) {
  static const std::regex entry(
      R"re(\{ "name" : "((?:[^"\\]|\\.)*)", "time" : (-?[0-9.]+(?:[eE][-+]?[0-9]+)?) \})re");
  std::vector<SeriesEntry> entries;
  std::ifstream in(path);
  for (std::string line; std::getline(in, line);) {
    if (line.find("\"name\"") == std::string::npos) continue;
    std::smatch match;
    if (!std::regex_search(line, match, entry)) {
      throw OutputError(path, "read the list of plotfiles", "unknown line \"" + line + "\"; delete the file");
    }
    entries.push_back({match[1], std::stod(match[2])});
  }
  return entries;
}

void write_series(const std::string& path, const std::vector<SeriesEntry>& entries) {
  std::ofstream out(path);
  out << "{\n  \"file-series-version\" : \"1.0\",\n  \"files\" : [\n";
  for (std::size_t i = 0; i < entries.size(); ++i) {
    std::array<char, 32> time{};  // the shortest text that reads back as the same number
    std::to_chars(time.data(), time.data() + time.size(), entries[i].time);
    out << "    { \"name\" : \"" << entries[i].name << "\", \"time\" : " << time.data() << " }"
        << (i + 1 < entries.size() ? ",\n" : "\n");
  }
  out << "  ]\n}\n";
  out.close();
  if (!out) throw OutputError(path, "write the list of plotfiles", std::generic_category().message(errno));
}

void replace_series(const std::string& path, const std::vector<SeriesEntry>& entries) {
  const std::string part = path + ".part";
  try {
    write_series(part, entries);
    complete_file(part, path);
  } catch (...) {
    remove_quietly(part);
    throw;
  }
}

}  // namespace

void write_plotfile(const std::string& path, const PlotHeader& header, const PlotFill& fill, MPI_Comm comm) {
  check_header(header, comm);
  int rank = 0;
  MPI_Comm_rank(comm, &rank);
  const std::string part = path + ".part";
  try {
    write_part(part, header, fill, comm);
    SharedFailure failure;
    if (rank == 0) failure.attempt(path, "rename the file", [&] { complete_file(part, path); });
    failure.agree(comm);
  } catch (...) {
    if (rank == 0) remove_quietly(part);
    throw;
  }
}

void append_series(const std::string& series_path, const std::string& file_name, double time_s) {
  std::vector<SeriesEntry> entries = read_series(series_path);
  const std::string name = json_text(file_name);
  std::erase_if(entries, [&](const SeriesEntry& old) { return old.time >= time_s || old.name == name; });
  entries.push_back({name, time_s});
  replace_series(series_path, entries);
}

void cut_series(const std::string& series_path, double last_time_s) {
  std::vector<SeriesEntry> entries = read_series(series_path);
  const auto later = [&](const SeriesEntry& entry) { return entry.time > last_time_s * (1 + 1e-12); };
  if (std::erase_if(entries, later) > 0) replace_series(series_path, entries);
}

}  // namespace dendrift::io

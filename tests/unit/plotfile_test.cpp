#include "io/plotfile.hpp"

#include <gtest/gtest.h>
#include <mpi.h>
#include <stdlib.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <vector>

#include "io/hdf5.hpp"

namespace dendrift::io {
namespace {

namespace fs = std::filesystem;

constexpr int kChildren = 1 << DIM;

int rank_of_world() {
  int rank = 0;
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  return rank;
}

/// An empty folder that all ranks know and that goes away with the object.
class SharedFolder {
 public:
  SharedFolder() {
    std::string name = (fs::temp_directory_path() / "plotfile_test_XXXXXX").string();
    if (rank_of_world() == 0) {
      EXPECT_NE(mkdtemp(name.data()), nullptr);
    }
    MPI_Bcast(name.data(), static_cast<int>(name.size()), MPI_CHAR, 0, MPI_COMM_WORLD);
    path_ = name;
  }
  ~SharedFolder() {
    MPI_Barrier(MPI_COMM_WORLD);
    std::error_code ignored;
    if (rank_of_world() == 0) fs::remove_all(path_, ignored);
  }
  [[nodiscard]] std::string file(const std::string& name) const { return (path_ / name).string(); }
  [[nodiscard]] std::ptrdiff_t entries() const {
    return std::distance(fs::directory_iterator(path_), fs::directory_iterator());
  }

 private:
  fs::path path_;
};

std::size_t power(int base) {
  std::size_t cells = 1;
  for (int d = 0; d < DIM; ++d) cells *= static_cast<std::size_t>(base);
  return cells;
}

void deal_out(PlotLevel& level) {
  int ranks = 0;
  MPI_Comm_size(MPI_COMM_WORLD, &ranks);
  for (std::size_t b = 0; b < level.blocks.size(); ++b) level.owner.push_back(static_cast<int>(b) % ranks);
  level.refined.resize(level.blocks.size());
}

/// Two blocks side by side along y, of which the second is refined.
PlotHeader two_levels() {
  PlotHeader header;
  header.time_s = 0.1;
  header.step = 42;
  header.block_cells = 4;
  header.dx0_um = 0.5;
  header.root_blocks.fill(1);
  header.root_blocks[1] = 2;
  for (int d = 0; d < DIM; ++d) header.origin_um[d] = -1.0 - d;
  header.periodic[1] = true;
  header.fields = {"phi", "velocity_x"};
  header.levels.resize(2);
  IntVec second{};
  second[1] = 1;
  header.levels[0].blocks = {IntVec{}, second};
  for (int child = 0; child < kChildren; ++child) {
    IntVec block{};
    for (int d = 0; d < DIM; ++d) block[d] = 2 * second[d] + (child >> d & 1);
    header.levels[1].blocks.push_back(block);
  }
  for (PlotLevel& level : header.levels) deal_out(level);
  header.levels[0].refined[1] = static_cast<std::uint8_t>((1U << kChildren) - 1U);
  return header;
}

double value(int level, std::size_t block, std::size_t item) {
  return 1000.0 * level + 100.0 * static_cast<double>(block) + 0.125 * static_cast<double>(item);
}

void fill_values(int level, std::size_t block, std::span<double> out) {
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = value(level, block, i);
}

std::vector<double> values_of_level(const PlotHeader& header, int level) {
  std::vector<double> values;
  for (std::size_t b = 0; b < header.levels[static_cast<std::size_t>(level)].blocks.size(); ++b) {
    std::vector<double> block(power(header.block_cells) * header.fields.size());
    fill_values(level, b, block);
    values.insert(values.end(), block.begin(), block.end());
  }
  return values;
}

/// What VTK must see of one field.
std::vector<double> field_of_level(const PlotHeader& header, int level, std::size_t field) {
  const std::vector<double> all = values_of_level(header, level);
  const std::size_t cells = power(header.block_cells);
  std::vector<double> values;
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (i / cells % header.fields.size() == field) values.push_back(all[i]);
  }
  return values;
}

std::string text_of(const std::string& path) {
  std::ifstream in(path);
  return {std::istreambuf_iterator<char>(in), {}};
}

TEST(Plotfile, RootDescribesTheRun) {
  const SharedFolder folder;
  const std::string path = folder.file("plt_0000042.hdf");
  write_plotfile(path, two_levels(), fill_values, MPI_COMM_WORLD);
  const File file = File::open(path, Access::read);
  EXPECT_EQ(file.read_attribute_text("filetype"), "VanillaAMRFileType");
  EXPECT_EQ(file.read_attribute<std::int32_t>("num_levels"), 2);
  EXPECT_EQ(file.read_attribute<std::int32_t>("max_level"), 1);
  EXPECT_EQ(file.read_attribute<std::int32_t>("num_components"), 2);
  EXPECT_EQ(file.read_attribute<std::int32_t>("iteration"), 42);
  EXPECT_EQ(file.read_attribute<double>("time"), 0.1);
  EXPECT_EQ(file.read_attribute_text("component_0"), "phi");
  EXPECT_EQ(file.read_attribute_text("component_1"), "velocity_x");
  EXPECT_EQ(file.open_group("Chombo_global").read_attribute<std::int32_t>("SpaceDim"), DIM);
  const Group vtk = file.open_group("VTKHDF");
  EXPECT_EQ(vtk.read_attribute_text("Type"), "OverlappingAMR");
  const double z = DIM == 3 ? -3.0 : 0.0;
  EXPECT_EQ(vtk.read_attribute_list<double>("Origin"), (std::vector<double>{-1.0, -2.0, z}));
  EXPECT_FALSE(fs::exists(path + ".part"));
}

TEST(Plotfile, LevelsDescribeTheirCells) {
  const SharedFolder folder;
  const std::string path = folder.file("plt.hdf");
  write_plotfile(path, two_levels(), fill_values, MPI_COMM_WORLD);
  const File file = File::open(path, Access::read);
  const Group fine = file.open_group("level_1");
  EXPECT_EQ(fine.read_attribute<double>("dx"), 0.25);
  EXPECT_EQ(fine.read_attribute<std::int32_t>("is_periodic_0"), 0);
  EXPECT_EQ(fine.read_attribute<std::int32_t>("is_periodic_1"), 1);
  const double thickness = DIM == 3 ? 0.25 : 0.5;
  EXPECT_EQ(file.open_group("VTKHDF/Level1").read_attribute_list<double>("Spacing"),
            (std::vector<double>{0.25, 0.25, thickness}));
  const auto boxes = file.open_dataset("VTKHDF/Level1/AMRBox").read_all<std::int32_t>();
  ASSERT_EQ(boxes.size(), 6U * kChildren);
  // The last child is the upper corner of the block at y = 1: cells 4..7 and 12..15.
  const std::vector<std::int32_t> last(boxes.end() - 6, boxes.end());
  EXPECT_EQ(last, (std::vector<std::int32_t>{4, 7, 12, 15, DIM == 3 ? 4 : 0, DIM == 3 ? 7 : 0}));
}

/// As other programs see it: through HDF5's own calls, by the names of the members.
TEST(Plotfile, BoxesAreRecordsOfNamedIndices) {
  const SharedFolder folder;
  const std::string path = folder.file("plt.hdf");
  write_plotfile(path, two_levels(), fill_values, MPI_COMM_WORLD);
  const hid_t file = H5Fopen(path.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT);
  const hid_t boxes = H5Dopen2(file, "level_0/boxes", H5P_DEFAULT);
  const hid_t upper = H5Tcreate(H5T_COMPOUND, sizeof(int));
  H5Tinsert(upper, "hi_j", 0, H5T_NATIVE_INT);
  std::vector<int> high(2);
  EXPECT_GE(H5Dread(boxes, upper, H5S_ALL, H5S_ALL, H5P_DEFAULT, high.data()), 0);
  EXPECT_EQ(high, (std::vector<int>{3, 7}));
  const hid_t domain = H5Aopen_by_name(file, "level_1", "prob_domain", H5P_DEFAULT, H5P_DEFAULT);
  int top = 0;
  EXPECT_GE(H5Aread(domain, upper, &top), 0);
  EXPECT_EQ(top, 15);
  H5Aclose(domain);
  H5Tclose(upper);
  H5Dclose(boxes);
  EXPECT_GE(H5Fclose(file), 0);
}

TEST(Plotfile, BothLayoutsGiveTheValues) {
  const SharedFolder folder;
  const std::string path = folder.file("plt.hdf");
  const PlotHeader header = two_levels();
  write_plotfile(path, header, fill_values, MPI_COMM_WORLD);
  const File file = File::open(path, Access::read);
  for (int level = 0; level < 2; ++level) {
    const std::string chombo = "level_" + std::to_string(level);
    EXPECT_EQ(file.open_dataset(chombo + "/data:datatype=0").read_all<double>(),
              values_of_level(header, level));
    const std::size_t per_block = 2 * power(4);
    const auto offsets = file.open_dataset(chombo + "/data:offsets=0").read_all<std::int64_t>();
    ASSERT_EQ(offsets.size(), header.levels[static_cast<std::size_t>(level)].blocks.size() + 1);
    EXPECT_EQ(offsets[1], static_cast<std::int64_t>(per_block));
    const Group cells = file.open_group("VTKHDF/Level" + std::to_string(level) + "/CellData");
    EXPECT_EQ(cells.open_dataset("phi").read_all<double>(), field_of_level(header, level, 0));
    EXPECT_EQ(cells.open_dataset("velocity_x").read_all<double>(), field_of_level(header, level, 1));
  }
  const auto marks = file.open_dataset("VTKHDF/Level0/CellData/vtkGhostType").read_all<std::uint8_t>();
  std::vector<std::uint8_t> expected(power(4), 0);
  expected.insert(expected.end(), power(4), 32);
  EXPECT_EQ(marks, expected);
}

TEST(Plotfile, MarksSingleOctants) {
  const SharedFolder folder;
  const std::string path = folder.file("plt.hdf");
  PlotHeader header = two_levels();
  header.levels[0].refined = {0, 0b10};  // upper x, lower y (and z)
  write_plotfile(path, header, fill_values, MPI_COMM_WORLD);
  const File file = File::open(path, Access::read);
  const auto marks = file.open_dataset("VTKHDF/Level0/CellData/vtkGhostType").read_all<std::uint8_t>();
  ASSERT_EQ(marks.size(), 2 * power(4));
  for (std::size_t cell = 0; cell < power(4); ++cell) {
    const bool covered = cell % 4 >= 2 && cell / 4 % 4 < 2 && cell / 16 < 2;
    EXPECT_EQ(marks[power(4) + cell], covered ? 32 : 0) << "cell " << cell;
  }
}

/// More blocks than one mapping of a virtual dataset takes, and many ranges per rank.
TEST(Plotfile, ManyBlocks) {
  const SharedFolder folder;
  const std::string path = folder.file("plt.hdf");
  PlotHeader header;
  header.block_cells = 2;
  header.dx0_um = 1;
  header.root_blocks.fill(1);
  header.root_blocks[0] = 2500;
  header.fields = {"a", "b", "c"};
  header.levels.resize(1);
  for (int b = 0; b < 2500; ++b) {
    IntVec block{};
    block[0] = b;
    header.levels[0].blocks.push_back(block);
  }
  deal_out(header.levels[0]);
  write_plotfile(path, header, fill_values, MPI_COMM_WORLD);
  const File file = File::open(path, Access::read);
  EXPECT_EQ(file.open_dataset("level_0/data:datatype=0").read_all<double>(), values_of_level(header, 0));
  EXPECT_EQ(file.open_dataset("VTKHDF/Level0/CellData/b").read_all<double>(), field_of_level(header, 0, 1));
}

TEST(Plotfile, UnwritableFolderIsAnErrorAndLeavesNothing) {
  const SharedFolder folder;
  const std::string path = folder.file("missing/plt.hdf");
  try {
    write_plotfile(path, two_levels(), fill_values, MPI_COMM_WORLD);
    FAIL() << "no exception";
  } catch (const OutputError& error) {
    EXPECT_EQ(error.path(), path + ".part");
    EXPECT_EQ(error.attempt(), "create the file");
    EXPECT_NE(error.reason().find("No such file or directory"), std::string::npos) << error.reason();
  }
  EXPECT_EQ(folder.entries(), 0);
}

TEST(Plotfile, FailureKeepsTheOlderFile) {
  const SharedFolder folder;
  const std::string path = folder.file("plt.hdf");
  write_plotfile(path, two_levels(), fill_values, MPI_COMM_WORLD);
  const std::string before = text_of(path);
  const PlotFill broken = [](int level, std::size_t block, std::span<double>) {
    if (level == 1 && block == 0) throw std::runtime_error("phi is not finite");
  };
  EXPECT_THROW(write_plotfile(path, two_levels(), broken, MPI_COMM_WORLD), OutputError);
  MPI_Barrier(MPI_COMM_WORLD);  // rank 0 cleans up
  EXPECT_EQ(folder.entries(), 1);
  EXPECT_EQ(text_of(path), before);
}

TEST(Plotfile, SameStateGivesSameBytes) {
  const SharedFolder folder;
  write_plotfile(folder.file("a.hdf"), two_levels(), fill_values, MPI_COMM_WORLD);
  write_plotfile(folder.file("b.hdf"), two_levels(), fill_values, MPI_COMM_WORLD);
  EXPECT_EQ(text_of(folder.file("a.hdf")), text_of(folder.file("b.hdf")));
}

TEST(Plotfile, RefusesAHeaderThatContradictsItself) {
  const SharedFolder folder;
  PlotHeader header = two_levels();
  header.levels[1].refined.pop_back();
  EXPECT_THROW(write_plotfile(folder.file("plt.hdf"), header, fill_values, MPI_COMM_WORLD),
               std::invalid_argument);
  header = two_levels();
  header.levels[0].owner[0] = 1 << 20;
  EXPECT_THROW(write_plotfile(folder.file("plt.hdf"), header, fill_values, MPI_COMM_WORLD),
               std::invalid_argument);
  EXPECT_EQ(folder.entries(), 0);
}

TEST(PlotSeries, ListsPlotfilesInOrder) {
  const SharedFolder folder;
  const std::string list = folder.file("plt.hdf.series");
  if (rank_of_world() != 0) return;
  append_series(list, "plt_0000000.hdf", 0);
  append_series(list, "plt_0000010.hdf", 0.1);
  EXPECT_EQ(text_of(list),
            "{\n  \"file-series-version\" : \"1.0\",\n  \"files\" : [\n"
            "    { \"name\" : \"plt_0000000.hdf\", \"time\" : 0 },\n"
            "    { \"name\" : \"plt_0000010.hdf\", \"time\" : 0.1 }\n  ]\n}\n");
  EXPECT_EQ(folder.entries(), 1);
}

TEST(PlotSeries, RestartReplacesWhatCameLater) {
  const SharedFolder folder;
  const std::string list = folder.file("plt.hdf.series");
  if (rank_of_world() != 0) return;
  for (int i = 0; i < 5; ++i) append_series(list, "plt_" + std::to_string(i) + ".hdf", 0.1 * i);
  append_series(list, "plt_2.hdf", 0.1 * 2);
  const std::string text = text_of(list);
  EXPECT_NE(text.find("\"plt_1.hdf\", \"time\" : 0.1 },"), std::string::npos) << text;
  EXPECT_NE(text.find("\"plt_2.hdf\", \"time\" : 0.2 }\n"), std::string::npos) << text;
  EXPECT_EQ(text.find("plt_3.hdf"), std::string::npos) << text;
  // The same step at another time is the same file.
  append_series(list, "plt_2.hdf", 0.25);
  EXPECT_EQ(text_of(list).find("0.2 }"), std::string::npos);
}

TEST(PlotSeries, DoesNotOverwriteAListItCannotRead) {
  const SharedFolder folder;
  const std::string list = folder.file("plt.hdf.series");
  if (rank_of_world() != 0) return;
  std::ofstream(list) << "{\"files\":[{\"time\":0,\"name\":\"other\"}]}";
  const std::string before = text_of(list);
  EXPECT_THROW(append_series(list, "plt_0.hdf", 0), OutputError);
  EXPECT_EQ(text_of(list), before);
  EXPECT_THROW(append_series(folder.file("missing/plt.hdf.series"), "plt_0.hdf", 0), OutputError);
  EXPECT_EQ(folder.entries(), 1);
}

TEST(Hdf5, ErrorsNameTheFileTheAttemptAndTheCause) {
  const SharedFolder folder;
  const std::string path = folder.file("empty.h5");
  if (rank_of_world() != 0) return;
  File::create(path).close();
  const File file = File::open(path, Access::read);
  EXPECT_FALSE(file.has("nothing"));
  try {
    (void)file.read_attribute<double>("time");
    FAIL() << "no exception";
  } catch (const OutputError& error) {
    EXPECT_EQ(error.path(), path);
    EXPECT_EQ(error.attempt(), "open attribute time");
    EXPECT_NE(error.reason().find("can't locate attribute"), std::string::npos) << error.reason();
  }
}

}  // namespace
}  // namespace dendrift::io

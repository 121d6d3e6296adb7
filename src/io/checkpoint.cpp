#include "io/checkpoint.hpp"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>

#include "amr/transfer.hpp"
#include "io/hdf5.hpp"

namespace dendrift::io {

namespace {

namespace fs = std::filesystem;

std::vector<int> checkpointed(const amr::FieldTable& fields) {
  std::vector<int> ids;
  for (int i = 0; i < fields.size(); ++i)
    if (fields.row(i).checkpoint) ids.push_back(i);
  return ids;
}

void sync_file(const std::string& path) {
  const int fd = ::open(path.c_str(), O_RDONLY);
  if (fd < 0) throw OutputError(path, "sync the file", std::strerror(errno));
  const int status = ::fsync(fd);
  ::close(fd);
  if (status != 0) throw OutputError(path, "sync the file", std::strerror(errno));
}

template <Number T>
void write_list(const Group& file, const std::string& name, const std::vector<T>& values) {
  const Dataspace space = Dataspace::simple(values.size());
  file.create_dataset(name, Type::of<T>(), space).write(std::span<const T>(values), space, Transfer::independent);
}

// Everything but the values of the fields; one rank alone.
void create_file(const std::string& path, const amr::Mesh& mesh, const RunState& state) {
  File file = File::create(path);
  const auto length = [&](int id) {
    return static_cast<hsize_t>(volume(mesh.fields().extent(id, mesh.layout().n)) * mesh.tree().size());
  };
  const std::vector<int> fields_kept = checkpointed(mesh.fields());
  hsize_t all_values = 0;
  for (const int id : fields_kept) all_values += length(id);
  // A full disk must show here, where one rank alone can still give up.
  reserve_space(path, (1 << 20) + all_values * sizeof(double) + mesh.owners().size() * 16);
  file.write_attribute("format", std::int32_t{CHECKPOINT_FORMAT});
  file.write_attribute("dim", std::int32_t{DIM});
  file.write_attribute("block_cells", std::int32_t{mesh.layout().n});
  file.write_attribute("time_tau0", state.time);
  file.write_attribute("step", state.step);
  write_list(file, "input", std::vector<std::uint8_t>(state.input.begin(), state.input.end()));
  {
    const Group numbers = file.create_group("numbers");
    for (const auto& [name, values] : state.numbers)
      if (!values.empty()) numbers.write_attribute(name, std::span<const double>(values));
    std::vector<std::int32_t> leaves;
    for (const amr::BlockIndex& b : mesh.tree().leaves()) {
      leaves.push_back(b.level);
      leaves.insert(leaves.end(), b.coord.begin(), b.coord.end());
    }
    write_list(file, "leaves", leaves);
    const Group fields = file.create_group("fields");
    for (const int id : fields_kept)
      static_cast<void>(
          fields.create_dataset(mesh.fields().row(id).name, Type::of<double>(), Dataspace::simple(length(id))));
  }
  file.close();
}

void write_fields(const std::string& path, const amr::Mesh& mesh, SharedFailure& failure) {
  File file = File::open(path, Access::write_values, mesh.comm());
  {
    const Group fields = file.open_group("fields");
    const Share share = share_of(mesh.owners(), mesh.comm());
    for (const int id : checkpointed(mesh.fields())) {
      const IntVec n = mesh.fields().extent(id, mesh.layout().n);
      const Dataset d = fields.open_dataset(mesh.fields().row(id).name);
      write_items<double>(d, share, static_cast<std::size_t>(volume(n)), failure,
                          [&](std::size_t leaf, std::span<double> out) {
                            const int slot = mesh.block(mesh.local(static_cast<int>(leaf))).slot;
                            amr::copy_box(amr::packed_ref(out.data(), n), {},
                                          amr::array_ref(mesh.array(id, slot), mesh.layout()), {}, n);
                          });
    }
  }
  file.close();
}

}  // namespace

void write_checkpoint(const std::string& path, const amr::Mesh& mesh, const RunState& state) {
  const std::string part = path + ".part";
  SharedFailure failure;
  if (mesh.rank() == 0) failure.attempt(part, "create the checkpoint", [&] { create_file(part, mesh, state); });
  failure.agree(mesh.comm());
  SharedFailure values;
  failure.attempt(part, "write the checkpoint", [&] { write_fields(part, mesh, values); });
  values.agree(mesh.comm());
  failure.agree(mesh.comm());
  if (mesh.rank() == 0)
    failure.attempt(path, "complete the checkpoint", [&] {
      release_excess_space(part);
      sync_file(part);
      rename_file(part, path);
    });
  failure.agree(mesh.comm());
}

std::vector<std::string> list_checkpoints(const std::string& dir) {
  std::vector<std::string> names;
  for (const fs::directory_entry& e : fs::directory_iterator(dir)) {
    const std::string name = e.path().filename().string();
    if (name.starts_with("chk_") && name.ends_with(".h5")) names.push_back(name);
  }
  std::ranges::sort(names, {}, [](const std::string& name) { return std::pair(name.size(), name); });
  return names;
}

std::string find_checkpoint(const std::string& file_or_dir) {
  if (!fs::exists(file_or_dir)) throw OutputError(file_or_dir, "restart", "no such file or folder");
  if (!fs::is_directory(file_or_dir)) return file_or_dir;
  const std::vector<std::string> names = list_checkpoints(file_or_dir);
  if (names.empty()) throw OutputError(file_or_dir, "restart", "the folder holds no checkpoint (chk_*.h5)");
  return (fs::path(file_or_dir) / names.back()).string();
}

RunState read_state(const std::string& path, MPI_Comm comm) {
  const File file = File::open(path, Access::read, comm);
  if (!file.has_attribute("format") || !file.has("leaves"))
    throw OutputError(path, "restart", "this is not a checkpoint of Dendrift");
  const auto format = file.read_attribute<std::int32_t>("format");
  if (format != CHECKPOINT_FORMAT)
    throw OutputError(path, "restart", "checkpoint format " + std::to_string(format) + ", this program reads " +
                                           std::to_string(CHECKPOINT_FORMAT));
  if (file.read_attribute<std::int32_t>("dim") != DIM)
    throw OutputError(path, "restart", "the checkpoint is not of a scene in " + std::to_string(DIM) + "D");
  RunState s;
  s.time = file.read_attribute<double>("time_tau0");
  s.step = file.read_attribute<std::int64_t>("step");
  const auto text = file.open_dataset("input").read_all<std::uint8_t>();
  s.input.assign(text.begin(), text.end());
  const Group numbers = file.open_group("numbers");
  const hid_t id = numbers.id();
  const int count = H5Aget_num_attrs(id);
  for (int i = 0; i < count; ++i) {
    char name[256] = {};
    H5Aget_name_by_idx(id, ".", H5_INDEX_NAME, H5_ITER_INC, static_cast<hsize_t>(i), name, sizeof name, H5P_DEFAULT);
    s.numbers[name] = numbers.read_attribute_list<double>(name);
  }
  return s;
}

std::vector<amr::BlockIndex> read_leaves(const std::string& path, MPI_Comm comm) {
  const File file = File::open(path, Access::read, comm);
  const auto raw = file.open_dataset("leaves").read_all<std::int32_t>();
  std::vector<amr::BlockIndex> leaves;
  for (std::size_t i = 0; i + DIM < raw.size(); i += DIM + 1) {
    amr::BlockIndex b;
    b.level = raw[i];
    std::copy_n(raw.begin() + static_cast<std::ptrdiff_t>(i) + 1, DIM, b.coord.begin());
    leaves.push_back(b);
  }
  return leaves;
}

void read_fields(const std::string& path, amr::Mesh& mesh) {
  const File file = File::open(path, Access::read, mesh.comm());
  const Group fields = file.open_group("fields");
  for (const int id : checkpointed(mesh.fields())) {
    const IntVec n = mesh.fields().extent(id, mesh.layout().n);
    const auto length = static_cast<std::size_t>(volume(n));
    std::vector<double> values(length);
    const Dataset d = fields.open_dataset(mesh.fields().row(id).name);
    for (const amr::Block& b : mesh.blocks()) {
      Dataspace where = Dataspace::simple(length * static_cast<std::size_t>(mesh.tree().size()));
      const auto leaf = static_cast<std::size_t>(b.leaf);
      where.select_items(std::span(&leaf, 1), length);
      d.read(std::span(values), where, Transfer::independent);
      amr::copy_box(amr::array_ref(mesh.array(id, b.slot), mesh.layout()), {},
                    amr::packed_ref(static_cast<const double*>(values.data()), n), {}, n);
    }
  }
}

}  // namespace dendrift::io

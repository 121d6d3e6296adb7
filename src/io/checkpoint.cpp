#include "io/checkpoint.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <optional>

#include "amr/comm.hpp"
#include "amr/transfer.hpp"
#include "io/crc32.hpp"
#include "io/hdf5.hpp"
#include "io/seal.hpp"
#include "io/trial.hpp"

namespace dendrift::io {

namespace {

namespace fs = std::filesystem;

template <Number T>
void write_list(const Group& file, const std::string& name, const std::vector<T>& values) {
  const Dataspace space = Dataspace::simple(values.size());
  file.create_dataset(name, Type::of<T>(), space).write(std::span<const T>(values), space, Transfer::independent);
}

template <class Work>
void together(const std::string& path, MPI_Comm comm, Work&& work) {
  SharedFailure failure;
  failure.attempt(path, "restart", work);
  failure.agree(comm);
}

std::vector<std::uint8_t> bytes_of(const std::string& text) { return {text.begin(), text.end()}; }

std::string text_of(const Dataset& d) {
  const auto bytes = d.read_all<std::uint8_t>();
  return {bytes.begin(), bytes.end()};
}

std::size_t bytes_of_state(const RunState& state) {
  std::size_t bytes = state.input.size() + state.origin.size();
  for (const auto& [name, values] : state.numbers) bytes += name.size() + values.size() * sizeof(double);
  return bytes;
}

std::uint32_t checksum_of(std::span<const double> values) { return crc32(std::as_bytes(values)); }

// Everything but the values of the fields and their checksums; one rank alone.
void create_file(const std::string& path, const amr::Mesh& mesh, const RunState& state) {
  const std::vector<int> fields_kept = checkpointed(mesh.fields());
  File file = File::create(path, seal_bytes(fields_kept.size()));
  const auto length = [&](int id) {
    return static_cast<hsize_t>(volume(mesh.fields().extent(id, mesh.layout().n)) * mesh.tree().size());
  };
  hsize_t all_values = 0;
  for (const int id : fields_kept) all_values += length(id);
  // A full disk must show here, where one rank alone can still give up.
  const hsize_t per_leaf = sizeof(std::int32_t) * (DIM + 1 + fields_kept.size());
  reserve_space(path, (1 << 16) + bytes_of_state(state) + all_values * sizeof(double) + mesh.owners().size() * per_leaf);
  file.write_attribute("format", std::int32_t{CHECKPOINT_FORMAT});
  file.write_attribute("dim", std::int32_t{DIM});
  file.write_attribute("block_cells", std::int32_t{mesh.layout().n});
  file.write_attribute("time_tau0", state.time);
  file.write_attribute("step", state.step);
  write_list(file, "input", bytes_of(state.input));
  write_list(file, "origin", bytes_of(state.origin));
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
    const Group checksums = file.create_group("checksums"), fields = file.create_group("fields");
    for (const int id : fields_kept) {
      const std::string& name = mesh.fields().row(id).name;
      static_cast<void>(checksums.create_dataset(name, Type::of<std::uint32_t>(), Dataspace::simple(mesh.owners().size())));
      static_cast<void>(fields.create_dataset(name, Type::of<double>(), Dataspace::simple(length(id))));
    }
  }
  file.close();
}

void write_fields(const std::string& path, const amr::Mesh& mesh, SharedFailure& failure) {
  File file = File::open(path, Access::write_values, mesh.comm());
  {
    const Group fields = file.open_group("fields"), checksums = file.open_group("checksums");
    const Share share = share_of(mesh.owners(), mesh.comm());
    std::vector<std::uint32_t> sums(mesh.owners().size());
    for (const int id : checkpointed(mesh.fields())) {
      const std::string& name = mesh.fields().row(id).name;
      const IntVec n = mesh.fields().extent(id, mesh.layout().n);
      write_items<double>(fields.open_dataset(name), share, static_cast<std::size_t>(volume(n)), failure,
                          [&](std::size_t leaf, std::span<double> out) {
                            const int slot = mesh.block(mesh.local(static_cast<int>(leaf))).slot;
                            amr::copy_box(amr::packed_ref(out.data(), n), {},
                                          amr::array_ref(mesh.array(id, slot), mesh.layout()), {}, n);
                            sums[leaf] = checksum_of(out);
                          });
      write_items<std::uint32_t>(checksums.open_dataset(name), share, 1, failure,
                                 [&](std::size_t leaf, std::span<std::uint32_t> out) { out[0] = sums[leaf]; });
    }
  }
  file.flush();
  file.close();
}

// One rank alone, when all values are there.
void seal_file(const std::string& path, const amr::Mesh& mesh) {
  std::vector<FileRange> values;
  {
    const File file = File::open(path, Access::read);
    for (const int id : checkpointed(mesh.fields()))
      values.push_back(file.open_dataset("fields/" + mesh.fields().row(id).name).range());
  }
  std::ranges::sort(values, {}, &FileRange::offset);
  write_seal(path, seal_bytes(values.size()), CHECKPOINT_FORMAT, values);
}

void write_part(const std::string& part, const amr::Mesh& mesh, const RunState& state) {
  SharedFailure failure;
  if (mesh.rank() == 0) failure.attempt(part, "create the checkpoint", [&] { create_file(part, mesh, state); });
  failure.agree(mesh.comm());
  SharedFailure values;
  failure.attempt(part, "write the checkpoint", [&] { write_fields(part, mesh, values); });
  values.agree(mesh.comm());
  failure.agree(mesh.comm());
}

std::string newer_format(int format) {
  return fmt::format("it is in checkpoint format {}, of a newer version; this program reads formats up to {}", format,
                     CHECKPOINT_FORMAT);
}

}  // namespace

std::vector<int> checkpointed(const amr::FieldTable& fields) {
  std::vector<int> ids;
  for (int i = 0; i < fields.size(); ++i)
    if (fields.row(i).checkpoint) ids.push_back(i);
  return ids;
}

void write_checkpoint(const std::string& path, const amr::Mesh& mesh, const RunState& state) {
  const std::string part = path + ".part";
  try {
    write_part(part, mesh, state);
    SharedFailure failure;
    if (mesh.rank() == 0)
      failure.attempt(path, "complete the checkpoint", [&] {
        release_excess_space(part);
        seal_file(part, mesh);
        complete_file(part, path);
      });
    failure.agree(mesh.comm());
  } catch (...) {
    if (mesh.rank() == 0) remove_quietly(part);
    throw;
  }
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

std::vector<std::string> find_checkpoints(const std::string& file_or_dir, MPI_Comm comm) {
  int rank = 0;
  MPI_Comm_rank(comm, &rank);
  std::string names;  // a line each, as one rank found them: others may not see the same at the same time
  SharedFailure failure;
  if (rank == 0)
    failure.attempt(file_or_dir, "restart", [&] {
      if (!fs::exists(file_or_dir)) throw OutputError(file_or_dir, "restart", "no such file or folder");
      if (!fs::is_directory(file_or_dir)) {
        names = file_or_dir + '\n';
        return;
      }
      for (const std::string& name : list_checkpoints(file_or_dir))
        names.insert(0, (fs::path(file_or_dir) / name).string() + '\n');
      if (names.empty()) throw OutputError(file_or_dir, "restart", "the folder holds no checkpoint (chk_*.h5)");
    });
  failure.agree(comm);
  const std::vector<char> all = amr::all_gather(std::span<const char>(names), comm);
  std::vector<std::string> paths;
  for (auto begin = all.begin(); begin != all.end();) {
    const auto end = std::find(begin, all.end(), '\n');
    paths.emplace_back(begin, end);
    begin = end + 1;
  }
  return paths;
}

namespace {

constexpr int TRIAL_SECONDS = 300;  // to open a file and to read all but the fields

// All but leaves and fields; the format is what the file says.
RunState state_of(const File& file) {
  if (!file.has_attribute("format") || !file.has("leaves"))
    throw OutputError(file.path(), "restart", "this is not a checkpoint of Dendrift");
  RunState s;
  s.format = file.read_attribute<std::int32_t>("format");
  if (s.format > CHECKPOINT_FORMAT) throw OutputError(file.path(), "restart", newer_format(s.format));
  s.dim = file.read_attribute<std::int32_t>("dim");
  s.time = file.read_attribute<double>("time_tau0");
  s.step = file.read_attribute<std::int64_t>("step");
  if (!std::isfinite(s.time) || s.time < 0 || s.step < 0)
    throw OutputError(file.path(), "restart", fmt::format("the file is damaged: it is of step {} and time {}", s.step, s.time));
  s.input = text_of(file.open_dataset("input"));
  if (file.has("origin")) s.origin = text_of(file.open_dataset("origin"));
  const Group numbers = file.open_group("numbers");
  for (const std::string& name : numbers.attribute_names()) s.numbers[name] = numbers.read_attribute_list<double>(name);
  return s;
}

std::vector<amr::BlockIndex> leaves_of(const File& file) {
  std::vector<amr::BlockIndex> leaves;
  const auto raw = file.open_dataset("leaves").read_all<std::int32_t>();
  for (std::size_t i = 0; i + DIM < raw.size(); i += DIM + 1) {
    amr::BlockIndex b;
    b.level = raw[i];
    std::copy_n(raw.begin() + static_cast<std::ptrdiff_t>(i) + 1, DIM, b.coord.begin());
    leaves.push_back(b);
  }
  return leaves;
}

// Reads what a restart reads, of fields one value, and forgets it; one rank alone.
void rehearse(const std::string& path) {
  const File file = File::open(path, Access::read);
  static_cast<void>(state_of(file));
  static_cast<void>(leaves_of(file));
  const Group fields = file.open_group("fields");
  for (const std::string& name : fields.names()) {
    const Dataset values = fields.open_dataset(name);
    const std::size_t count = values.count();
    if (count == 0) continue;
    Dataspace first = Dataspace::simple(count);
    first.select_runs(0, 1, 1, 1);
    double value = 0;
    values.read(std::span(&value, 1), first, Transfer::independent);
    if (file.has("checksums/" + name)) static_cast<void>(file.open_dataset("checksums/" + name).read_all<std::uint32_t>());
  }
}

}  // namespace

RunState read_state(const std::string& path, MPI_Comm comm) {
  int rank = 0;
  MPI_Comm_rank(comm, &rank);
  int sealed = 0;
  // Before HDF5 opens the file, and by one rank: damaged bookkeeping must not reach HDF5. Where it does, in a file without a
  // seal or with one that was made for it, HDF5 may crash: not in this process.
  together(path, comm, [&] {
    if (rank != 0) return;
    sealed = check_seal(path, CHECKPOINT_FORMAT).value_or(0);
    if (sealed > CHECKPOINT_FORMAT) throw OutputError(path, "restart", newer_format(sealed));
    if (const std::string end = what_kills([&] { rehearse(path); }, TRIAL_SECONDS); !end.empty())
      throw OutputError(path, "restart", "the file is damaged: HDF5 does not survive reading it: " + end);
  });
  MPI_Bcast(&sealed, 1, MPI_INT, 0, comm);  // all must come to the same verdict
  RunState s;
  together(path, comm, [&] {
    s = state_of(File::open(path, Access::read, comm));
    if (s.format > 1 && s.format != sealed)
      throw OutputError(path, "restart", "the file is damaged: its seal, at the beginning, is not there");
  });
  return s;
}

std::vector<amr::BlockIndex> read_leaves(const std::string& path, MPI_Comm comm) {
  std::vector<amr::BlockIndex> leaves;
  together(path, comm, [&] { leaves = leaves_of(File::open(path, Access::read, comm)); });
  return leaves;
}

std::vector<std::string> missing_fields(const std::string& path, const amr::Mesh& mesh) {
  std::vector<std::string> missing;
  together(path, mesh.comm(), [&] {
    const File file = File::open(path, Access::read, mesh.comm());
    const Group fields = file.open_group("fields");
    for (const int id : checkpointed(mesh.fields()))
      if (const std::string& name = mesh.fields().row(id).name; !fields.has(name)) missing.push_back(name);
  });
  return missing;
}

namespace {

// The field of this rank's blocks; `sums`: of all leaves, none in files of format 1.
void read_field(const Dataset& d, amr::Mesh& mesh, int id, std::span<const std::uint32_t> sums) {
  const IntVec n = mesh.fields().extent(id, mesh.layout().n);
  const auto length = static_cast<std::size_t>(volume(n));
  const std::size_t leaves = mesh.owners().size();
  if (d.count() != length * leaves || (!sums.empty() && sums.size() != leaves))
    throw OutputError(d.path(), "restart", "field " + mesh.fields().row(id).name + " is not as long as the leaves need");
  std::vector<double> values(length);
  for (const amr::Block& b : mesh.blocks()) {
    const auto leaf = static_cast<std::size_t>(b.leaf);
    Dataspace where = Dataspace::simple(length * leaves);
    where.select_items(std::span(&leaf, 1), length);
    d.read(std::span(values), where, Transfer::independent);
    if (!sums.empty() && checksum_of(values) != sums[leaf])
      throw OutputError(d.path(), "restart",
                        fmt::format("the file is damaged: field {} has another checksum in leaf {} of {} than when written",
                                    mesh.fields().row(id).name, leaf, leaves));
    amr::copy_box(amr::array_ref(mesh.array(id, b.slot), mesh.layout()), {},
                  amr::packed_ref(static_cast<const double*>(values.data()), n), {}, n);
  }
}

}  // namespace

void read_fields(const std::string& path, amr::Mesh& mesh) {
  together(path, mesh.comm(), [&] {
    const File file = File::open(path, Access::read, mesh.comm());
    const Group fields = file.open_group("fields");
    const bool checked = file.read_attribute<std::int32_t>("format") > 1;
    SharedFailure failure;  // a rank that finds damage still opens what the others open, all together
    for (const int id : checkpointed(mesh.fields())) {
      const std::string& name = mesh.fields().row(id).name;
      const Dataset d = fields.open_dataset(name);
      std::vector<std::uint32_t> sums;
      if (checked) sums = file.open_dataset("checksums/" + name).read_all<std::uint32_t>();
      failure.attempt(path, "restart", [&] { read_field(d, mesh, id, sums); });
    }
    failure.agree(mesh.comm());
  });
}

}  // namespace dendrift::io

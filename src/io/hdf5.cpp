#include "io/hdf5.hpp"

#include <fcntl.h>
#include <semaphore.h>
#include <unistd.h>
#ifdef __linux__
#include <sys/resource.h>
#endif

#include <cerrno>
#include <filesystem>
#include <system_error>
#include <utility>

namespace dendrift::io {

using detail::check;

OutputError::OutputError(std::string path, std::string attempt, std::string reason)
    : std::runtime_error((path.empty() ? "" : path + ": ") + "could not " + attempt + ": " + reason),
      path_(std::move(path)),
      attempt_(std::move(attempt)),
      reason_(std::move(reason)) {}

std::string detail::last_error() {
  // What was reported last is what the caller asked for, what was reported first is the cause. Between them
  // are HDF5's internals and, after a failed flush, everything that failed in its wake.
  std::vector<std::string> reports;
  const auto collect = [](unsigned, const H5E_error2_t* error, void* out) -> herr_t {
    std::string text = error->desc ? error->desc : "";
    std::replace(text.begin(), text.end(), '\n', ' ');
    if (!text.empty()) static_cast<std::vector<std::string>*>(out)->push_back(std::move(text));
    return 0;
  };
  H5Ewalk2(H5E_DEFAULT, H5E_WALK_UPWARD, collect, &reports);
  H5Eclear2(H5E_DEFAULT);
  if (reports.empty()) return "HDF5 gave no reason";
  if (reports.front() == reports.back()) return "HDF5: " + reports.front();
  return "HDF5: " + reports.back() + ": " + reports.front();
}

namespace {

bool broken = false;

}  // namespace

bool hdf5_is_broken() noexcept { return broken; }

herr_t Handle::close() {
  if (id_ < 0) return 0;
  const herr_t status = closer_(std::exchange(id_, -1));
  broken = broken || status < 0;
  return status;
}

Handle& Handle::operator=(Handle&& other) noexcept {
  if (this != &other) {
    close();
    id_ = std::exchange(other.id_, -1);
    closer_ = other.closer_;
  }
  return *this;
}

// ---- types and spaces ---------------------------------------------------------------------------

Type::Type(hid_t id) : handle_(check(id, "", "make an HDF5 type"), H5Tclose) {}

Type Type::copy_of(hid_t predefined) { return Type(H5Tcopy(predefined)); }

Type Type::text(std::size_t length) {
  Type type(H5Tcopy(H5T_C_S1));
  check(H5Tset_size(type.id(), length), "", "make an HDF5 string type");
  check(H5Tset_strpad(type.id(), H5T_STR_NULLPAD), "", "make an HDF5 string type");
  return type;
}

Type Type::record(const Type& member, std::size_t member_size, std::span<const std::string> members) {
  Type type(H5Tcreate(H5T_COMPOUND, member_size * members.size()));
  for (std::size_t i = 0; i < members.size(); ++i) {
    check(H5Tinsert(type.id(), members[i].c_str(), i * member_size, member.id()), "",
          "make an HDF5 record type");
  }
  return type;
}

Dataspace::Dataspace(hid_t id) : handle_(check(id, "", "make an HDF5 dataspace"), H5Sclose) {}

Dataspace Dataspace::scalar() { return Dataspace(H5Screate(H5S_SCALAR)); }

Dataspace Dataspace::simple(std::span<const hsize_t> extent) {
  return Dataspace(H5Screate_simple(static_cast<int>(extent.size()), extent.data(), nullptr));
}

Dataspace Dataspace::of_dataset(hid_t dataset, const std::string& path) {
  return Dataspace(check(H5Dget_space(dataset), path, "read the shape of a dataset"));
}

void Dataspace::select_none() { check(H5Sselect_none(id()), "", "select part of a dataset"); }

void Dataspace::add_range(hsize_t start, hsize_t count) {
  const hsize_t one = 1;
  check(H5Sselect_hyperslab(id(), H5S_SELECT_OR, &start, nullptr, &one, &count), "",
        "select part of a dataset");
}

void Dataspace::select_items(std::span<const std::size_t> items, std::size_t length) {
  select_none();
  for (std::size_t i = 0; i < items.size();) {
    std::size_t end = i + 1;  // neighbours are joined: HDF5 spends time on every run of a selection
    while (end < items.size() && items[end] == items[end - 1] + 1) ++end;
    add_range(items[i] * length, (end - i) * length);
    i = end;
  }
}

void Dataspace::select_runs(hsize_t start, hsize_t stride, hsize_t count, hsize_t length) {
  check(H5Sselect_hyperslab(id(), H5S_SELECT_SET, &start, &stride, &count, &length), "",
        "select part of a dataset");
}

std::vector<hsize_t> Dataspace::extent() const {
  const int rank = check(H5Sget_simple_extent_ndims(id()), "", "read the shape of a dataset");
  std::vector<hsize_t> extent(static_cast<std::size_t>(rank));
  check(H5Sget_simple_extent_dims(id(), extent.data(), nullptr), "", "read the shape of a dataset");
  return extent;
}

hsize_t Dataspace::selected() const {
  return static_cast<hsize_t>(check(H5Sget_select_npoints(id()), "", "count a selection"));
}

// ---- attributes ---------------------------------------------------------------------------------

void Location::write_attribute(const std::string& name, const Type& type, const Dataspace& space,
                               const void* data) const {
  const Handle attribute(
      check(H5Acreate2(id(), name.c_str(), type.id(), space.id(), H5P_DEFAULT, H5P_DEFAULT), path_,
            "create attribute", name),
      H5Aclose);
  check(H5Awrite(attribute.id(), type.id(), data), path_, "write attribute", name);
}

void Location::write_attribute(const std::string& name, std::string_view text) const {
  // HDF5 has no strings of length zero: an empty one is stored as a single NUL.
  const std::string bytes(text.empty() ? std::string_view("\0", 1) : text);
  write_attribute(name, Type::text(bytes.size()), Dataspace::scalar(), bytes.data());
}

bool Location::has_attribute(const std::string& name) const {
  return check(H5Aexists(id(), name.c_str()), path_, "look for attribute", name) > 0;
}

namespace {

// get(i, name, room): one of HDF5's functions that copy a name.
template <class Get>
std::vector<std::string> names_by_index(hsize_t count, const std::string& path, Get&& get) {
  std::vector<std::string> names;
  for (hsize_t i = 0; i < count; ++i) {
    char name[256] = {};
    check(get(i, name, sizeof name), path, "read a name");
    names.emplace_back(name);
  }
  return names;
}

}  // namespace

std::vector<std::string> Location::attribute_names() const {
  const int count = check(H5Aget_num_attrs(id()), path_, "count attributes");
  return names_by_index(static_cast<hsize_t>(count), path_, [&](hsize_t i, char* name, std::size_t size) {
    return H5Aget_name_by_idx(id(), ".", H5_INDEX_NAME, H5_ITER_INC, i, name, size, H5P_DEFAULT);
  });
}

Handle Location::open_attribute(const std::string& name) const {
  return {check(H5Aopen(id(), name.c_str(), H5P_DEFAULT), path_, "open attribute", name), H5Aclose};
}

std::size_t Location::attribute_count(const Handle& attribute, const std::string& name) const {
  const Handle space(check(H5Aget_space(attribute.id()), path_, "read attribute", name), H5Sclose);
  return static_cast<std::size_t>(
      check(H5Sget_simple_extent_npoints(space.id()), path_, "read attribute", name));
}

void Location::read_attribute(const std::string& name, const Handle& attribute, hid_t type, void* out) const {
  check(H5Aread(attribute.id(), type, out), path_, "read attribute", name);
}

std::string Location::read_attribute_text(const std::string& name) const {
  const Handle attribute = open_attribute(name);
  const Handle type(check(H5Aget_type(attribute.id()), path_, "read attribute", name), H5Tclose);
  if (H5Tget_class(type.id()) != H5T_STRING || H5Tis_variable_str(type.id()) > 0 ||
      attribute_count(attribute, name) != 1) {
    throw OutputError(path_, "read attribute " + name, "it is not one string of fixed length");
  }
  std::string text(H5Tget_size(type.id()), '\0');
  read_attribute(name, attribute, type.id(), text.data());
  return text.substr(0, text.find('\0'));
}

// ---- datasets -----------------------------------------------------------------------------------

namespace {

Handle transfer_properties(Transfer transfer, const std::string& path) {
  Handle properties(check(H5Pcreate(H5P_DATASET_XFER), path, "prepare a transfer"), H5Pclose);
  const H5FD_mpio_xfer_t mode =
      transfer == Transfer::collective ? H5FD_MPIO_COLLECTIVE : H5FD_MPIO_INDEPENDENT;
  check(H5Pset_dxpl_mpio(properties.id(), mode), path, "prepare a transfer");
  return properties;
}

/// One-dimensional, everything selected; an empty one still needs an extent for some versions of HDF5.
Dataspace memory_space(hsize_t count) {
  Dataspace space = Dataspace::simple(count ? count : 1);
  if (count == 0) space.select_none();
  return space;
}

std::string dataset_name(hid_t dataset) {
  char name[256] = "";
  H5Iget_name(dataset, name, sizeof name);
  return name;
}

}  // namespace

void Dataset::write(const Type& type, const void* data, const Dataspace& where, Transfer transfer) const {
  const Dataspace memory = memory_space(where.selected());
  const Handle properties = transfer_properties(transfer, path());
  if (H5Dwrite(id(), type.id(), memory.id(), where.id(), properties.id(), data) >= 0) return;
  const std::string reason = detail::last_error();
  throw OutputError(path(), "write dataset " + dataset_name(id()), reason);
}

void Dataset::read(const Type& type, void* out, std::size_t count, const Dataspace& where,
                   Transfer transfer) const {
  const Dataspace memory = memory_space(count);
  const Handle properties = transfer_properties(transfer, path());
  if (H5Dread(id(), type.id(), memory.id(), where.id(), properties.id(), out) >= 0) return;
  const std::string reason = detail::last_error();
  throw OutputError(path(), "read dataset " + dataset_name(id()), reason);
}

std::size_t Dataset::count() const {
  const hsize_t count = space().selected();
  const Handle file(check(H5Iget_file_id(id()), path(), "find the file"), H5Fclose);
  const Handle properties(check(H5Dget_create_plist(id()), path(), "read the layout of a dataset"), H5Pclose);
  const Handle type(check(H5Dget_type(id()), path(), "read the type of a dataset"), H5Tclose);
  hsize_t bytes = 0;
  check(H5Fget_filesize(file.id(), &bytes), path(), "find the size of the file");
  if (H5Pget_layout(properties.id()) != H5D_VIRTUAL) bytes = std::min(bytes, H5Dget_storage_size(id()));
  if (count <= bytes / std::max<std::size_t>(1, H5Tget_size(type.id()))) return count;
  throw OutputError(path(), "read dataset " + dataset_name(id()),
                    "the file is damaged: it claims " + std::to_string(count) + " values in " + std::to_string(bytes) + " bytes");
}

FileRange Dataset::range() const {
  const haddr_t offset = H5Dget_offset(id());
  const hsize_t bytes = H5Dget_storage_size(id());
  if (offset == HADDR_UNDEF) throw OutputError(path(), "find dataset " + dataset_name(id()), detail::last_error());
  return {offset, bytes};
}

// ---- groups and files ---------------------------------------------------------------------------

namespace {

Handle dataset_properties(const std::string& path) {
  Handle properties(check(H5Pcreate(H5P_DATASET_CREATE), path, "prepare a dataset"), H5Pclose);
  // Without a time stamp two runs write the same bytes.
  check(H5Pset_obj_track_times(properties.id(), false), path, "prepare a dataset");
  return properties;
}

}  // namespace

Group Group::create_group(const std::string& name) const {
  const hid_t id = H5Gcreate2(this->id(), name.c_str(), H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT);
  return {check(id, path(), "create group", name), path()};
}

Group Group::open_group(const std::string& name) const {
  return {check(H5Gopen2(id(), name.c_str(), H5P_DEFAULT), path(), "open group", name), path()};
}

Dataset Group::create_dataset(const std::string& name, const Type& type, const Dataspace& space,
                              const Handle& properties) const {
  const hid_t id =
      H5Dcreate2(this->id(), name.c_str(), type.id(), space.id(), H5P_DEFAULT, properties.id(), H5P_DEFAULT);
  return {check(id, path(), "create dataset", name), path()};
}

Dataset Group::create_dataset(const std::string& name, const Type& type, const Dataspace& space) const {
  const Handle properties = dataset_properties(path());
  check(H5Pset_alloc_time(properties.id(), H5D_ALLOC_TIME_EARLY), path(), "prepare dataset", name);
  check(H5Pset_fill_time(properties.id(), H5D_FILL_TIME_NEVER), path(), "prepare dataset", name);
  return create_dataset(name, type, space, properties);
}

void Group::create_virtual_dataset(const std::string& name, const Type& type, const Dataspace& space,
                                   std::span<const Mapping> mappings) const {
  const Handle properties = dataset_properties(path());
  for (const Mapping& map : mappings) {
    // "." is HDF5's name for the file that holds the virtual dataset, whatever it is called later.
    check(H5Pset_virtual(properties.id(), map.target.id(), ".", map.source.c_str(), map.source_space.id()),
          path(), "map virtual dataset", name);
  }
  (void)create_dataset(name, type, space, properties);
}

Dataset Group::open_dataset(const std::string& name) const {
  return {check(H5Dopen2(id(), name.c_str(), H5P_DEFAULT), path(), "open dataset", name), path()};
}

bool Group::has(const std::string& name) const {
  return check(H5Lexists(id(), name.c_str(), H5P_DEFAULT), path(), "look for", name) > 0;
}

std::vector<std::string> Group::names() const {
  H5G_info_t info = {};
  check(H5Gget_info(id(), &info), path(), "read a group");
  return names_by_index(info.nlinks, path(), [&](hsize_t i, char* name, std::size_t size) {
    return H5Lget_name_by_idx(id(), ".", H5_INDEX_NAME, H5_ITER_INC, i, name, size, H5P_DEFAULT);
  });
}

namespace {

Handle access_properties(const std::string& path) {
  check(H5Eset_auto2(H5E_DEFAULT, nullptr, nullptr), path, "silence HDF5");
  return {check(H5Pcreate(H5P_FILE_ACCESS), path, "prepare the file"), H5Pclose};
}

Handle shared_access_properties(const std::string& path, MPI_Comm comm) {
  Handle properties = access_properties(path);
  check(H5Pset_fapl_mpio(properties.id(), comm, MPI_INFO_NULL), path, "prepare the file");
  // One rank reads the description of the file for all.
  check(H5Pset_all_coll_metadata_ops(properties.id(), true), path, "prepare the file");
  return properties;
}

// Open MPI's I/O guards what it knows of a file by a semaphore of the machine that bears the file's name alone. A process that
// is killed while it holds it leaves it locked, and whoever opens a file of that name next, in whatever folder, waits for
// ever. Those who hold it now keep theirs when the name goes.
void forget_semaphore([[maybe_unused]] const std::string& path, [[maybe_unused]] MPI_Comm comm) {
#ifdef OPEN_MPI
  int rank = 0;
  MPI_Comm_rank(comm, &rank);
  if (rank == 0) sem_unlink(("/OMPIO_" + std::filesystem::path(path).filename().string()).c_str());
  MPI_Barrier(comm);
#endif
}

hid_t open_file(const std::string& path, Access access, const Handle& properties) {
  const unsigned flags = access == Access::read ? H5F_ACC_RDONLY : H5F_ACC_RDWR;
  return check(H5Fopen(path.c_str(), flags, properties.id()), path, "open the file");
}

}  // namespace

File File::create(const std::string& path, std::uint64_t room) {
  const Handle properties = access_properties(path);
  const Handle creation(check(H5Pcreate(H5P_FILE_CREATE), path, "prepare the file"), H5Pclose);
  check(H5Pset_userblock(creation.id(), room), path, "prepare the file");
  const hid_t id = H5Fcreate(path.c_str(), H5F_ACC_TRUNC, creation.id(), properties.id());
  return {check(id, path, "create the file"), H5Fclose, path};
}

File File::open(const std::string& path, Access access) {
  return {open_file(path, access, access_properties(path)), H5Fclose, path};
}

File File::open(const std::string& path, Access access, MPI_Comm comm) {
  forget_semaphore(path, comm);
  return {open_file(path, access, shared_access_properties(path, comm)), H5Fclose, path};
}

void File::flush() const { check(H5Fflush(id(), H5F_SCOPE_GLOBAL), path(), "write out the file"); }

void File::close() { check(handle_.close(), path(), "close the file"); }

// ---- failures of a group of ranks ---------------------------------------------------------------

namespace {

std::string broadcast(std::string text, int root, MPI_Comm comm) {
  int length = static_cast<int>(text.size());
  MPI_Bcast(&length, 1, MPI_INT, root, comm);
  text.resize(static_cast<std::size_t>(length));
  MPI_Bcast(text.data(), length, MPI_CHAR, root, comm);
  return text;
}

}  // namespace

void SharedFailure::agree(MPI_Comm comm) const {
  int rank = 0;
  int size = 0;
  MPI_Comm_rank(comm, &rank);
  MPI_Comm_size(comm, &size);
  int root = failure_ ? rank : size;
  MPI_Allreduce(MPI_IN_PLACE, &root, 1, MPI_INT, MPI_MIN, comm);
  if (root == size) return;
  const std::string path = broadcast(failure_ ? failure_->path() : "", root, comm);
  const std::string attempt = broadcast(failure_ ? failure_->attempt() : "", root, comm);
  const std::string reason = broadcast(failure_ ? failure_->reason() : "", root, comm);
  throw OutputError(path, attempt, reason);
}

Share share_of(std::span<const int> owner, MPI_Comm comm) {
  int rank = 0;
  int ranks = 0;
  MPI_Comm_rank(comm, &rank);
  MPI_Comm_size(comm, &ranks);
  Share share;
  share.items = owner.size();
  std::vector<std::size_t> owned(static_cast<std::size_t>(ranks));
  for (std::size_t item = 0; item < owner.size(); ++item) {
    ++owned[static_cast<std::size_t>(owner[item])];
    if (owner[item] == rank) share.mine.push_back(item);
  }
  share.most = *std::max_element(owned.begin(), owned.end());
  return share;
}

// ---- files by name ------------------------------------------------------------------------------

void reserve_space(const std::string& path, std::uint64_t bytes) {
#ifdef __linux__
  struct rlimit limit = {};
  int error = getrlimit(RLIMIT_FSIZE, &limit) == 0 && bytes > limit.rlim_cur ? EFBIG : 0;
  const int file = ::open(path.c_str(), O_WRONLY | O_CLOEXEC);
  if (file < 0) error = errno;
  const auto length = static_cast<off_t>(bytes);
  const auto reserve = [&] { return ::fallocate(file, FALLOC_FL_KEEP_SIZE, 0, length) == 0 ? 0 : errno; };
  if (error == 0) error = reserve();
  while (error == EINTR) error = reserve();  // a scheduler's signal came in
  if (file >= 0) ::close(file);
  if (error == 0 || error == EOPNOTSUPP || error == ENOSYS) return;
  throw OutputError(path, "reserve " + std::to_string(bytes) + " bytes",
                    std::generic_category().message(error));
#else
  (void)path;
  (void)bytes;
#endif
}

void release_excess_space(const std::string& path) {
  // Setting the size a file already has frees blocks beyond it.
  std::error_code ignored;
  const auto size = std::filesystem::file_size(path, ignored);
  if (!ignored) std::filesystem::resize_file(path, size, ignored);
}

namespace {

void sync(const std::string& path, int flags, bool required) {
  const int file = ::open(path.c_str(), flags | O_CLOEXEC);
  int error = file < 0 ? errno : 0;
  if (error == 0 && ::fsync(file) != 0) error = errno;
  if (file >= 0) ::close(file);
  if (error != 0 && required) throw OutputError(path, "bring the file to the disk", std::generic_category().message(error));
}

}  // namespace

void complete_file(const std::string& part, const std::string& path) {
  sync(part, O_RDONLY, true);
  std::error_code error;
  std::filesystem::rename(part, path, error);
  if (error) throw OutputError(path, "rename " + part + " to it", error.message());
  // Some file systems cannot sync a folder. The file is whole either way; only its name might not outlive a power failure.
  const std::string folder = std::filesystem::path(path).parent_path().string();
  sync(folder.empty() ? "." : folder, O_RDONLY | O_DIRECTORY, false);
}

void remove_quietly(const std::string& path) noexcept {
  std::error_code ignored;
  std::filesystem::remove(path, ignored);
}

}  // namespace dendrift::io

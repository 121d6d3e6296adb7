#pragma once

#include <hdf5.h>
#include <mpi.h>

#include <algorithm>
#include <concepts>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

/// A thin layer over HDF5's C interface: handles that close themselves, and failures as exceptions. Every
/// operation throws OutputError when HDF5 reports a failure; HDF5 itself prints nothing.
namespace dendrift::io {

/// A file that could not be written or read.
class OutputError : public std::runtime_error {
 public:
  /// attempt completes "could not ...": "create the file"; reason is the library's or the system's own
  /// message.
  OutputError(std::string path, std::string attempt, std::string reason);
  [[nodiscard]] const std::string& path() const { return path_; }
  [[nodiscard]] const std::string& attempt() const { return attempt_; }
  [[nodiscard]] const std::string& reason() const { return reason_; }

 private:
  std::string path_, attempt_, reason_;
};

/// Owns one HDF5 identifier and the function that closes it.
class Handle {
 public:
  using Closer = herr_t (*)(hid_t);
  Handle() = default;
  Handle(hid_t id, Closer closer) : id_(id), closer_(closer) {}
  Handle(Handle&& other) noexcept : id_(std::exchange(other.id_, -1)), closer_(other.closer_) {}
  Handle& operator=(Handle&& other) noexcept;
  ~Handle() { close(); }
  [[nodiscard]] hid_t id() const { return id_; }
  /// Negative on failure; the identifier is given up in any case.
  herr_t close();

 private:
  hid_t id_ = -1;
  Closer closer_ = nullptr;
};

/// Whether something could not be closed, for want of disk space as a rule. HDF5 1.10 then crashes when it ends, which is part
/// of MPI_Finalize and of exit().
[[nodiscard]] bool hdf5_is_broken() noexcept;

/// The numbers that files hold. They are stored as they lie in memory.
template <class T>
concept Number =
    std::same_as<T, std::uint8_t> || std::same_as<T, std::int32_t> || std::same_as<T, std::uint32_t> ||
    std::same_as<T, std::int64_t> || std::same_as<T, std::uint64_t> || std::same_as<T, double>;

class Type {
 public:
  template <Number T>
  [[nodiscard]] static Type of();
  /// ASCII of exactly this many bytes (at least 1), padded with NUL.
  [[nodiscard]] static Type text(std::size_t length);
  /// Compound of equal members that follow each other without padding.
  template <Number T>
  [[nodiscard]] static Type record(std::span<const std::string> members) {
    return record(of<T>(), sizeof(T), members);
  }
  [[nodiscard]] hid_t id() const { return handle_.id(); }

 private:
  explicit Type(hid_t id);
  static Type copy_of(hid_t predefined);
  static Type record(const Type& member, std::size_t member_size, std::span<const std::string> members);
  Handle handle_;
};

/// The shape of a dataset and the part of it that is meant.
class Dataspace {
 public:
  [[nodiscard]] static Dataspace scalar();
  /// Slowest dimension first; everything is selected.
  [[nodiscard]] static Dataspace simple(std::span<const hsize_t> extent);
  [[nodiscard]] static Dataspace simple(hsize_t count) { return simple(std::span(&count, 1)); }
  [[nodiscard]] static Dataspace of_dataset(hid_t dataset, const std::string& path);
  void select_none();
  /// Adds [start, start + count) to the selection of a one-dimensional space.
  void add_range(hsize_t start, hsize_t count);
  /// Selects items, ascending, of a one-dimensional space that consists of items of `length` values.
  void select_items(std::span<const std::size_t> items, std::size_t length);
  /// Selects `count` runs of `length`, `stride` apart, of a one-dimensional space.
  void select_runs(hsize_t start, hsize_t stride, hsize_t count, hsize_t length);
  [[nodiscard]] std::vector<hsize_t> extent() const;
  [[nodiscard]] hsize_t selected() const;
  [[nodiscard]] hid_t id() const { return handle_.id(); }

 private:
  explicit Dataspace(hid_t id);
  Handle handle_;
};

/// How the ranks that share a file take part in one transfer: all of them together, or the caller alone.
enum class Transfer { collective, independent };

/// What files, groups and datasets have in common: a place in a named file that carries attributes.
class Location {
 public:
  template <Number T>
  void write_attribute(const std::string& name, T value) const {
    write_attribute(name, Type::of<T>(), Dataspace::scalar(), &value);
  }
  template <Number T>
  void write_attribute(const std::string& name, std::span<const T> values) const {
    write_attribute(name, Type::of<T>(), Dataspace::simple(values.size()), values.data());
  }
  void write_attribute(const std::string& name, std::string_view text) const;
  void write_attribute(const std::string& name, const Type&, const Dataspace&, const void* data) const;

  [[nodiscard]] bool has_attribute(const std::string& name) const;
  [[nodiscard]] std::vector<std::string> attribute_names() const;
  template <Number T>
  [[nodiscard]] T read_attribute(const std::string& name) const;
  template <Number T>
  [[nodiscard]] std::vector<T> read_attribute_list(const std::string& name) const;
  /// A string of fixed length.
  [[nodiscard]] std::string read_attribute_text(const std::string& name) const;

  [[nodiscard]] hid_t id() const { return handle_.id(); }
  [[nodiscard]] const std::string& path() const { return path_; }

 protected:
  Location(hid_t id, Handle::Closer closer, std::string path) : handle_(id, closer), path_(std::move(path)) {}
  [[nodiscard]] Handle open_attribute(const std::string& name) const;
  [[nodiscard]] std::size_t attribute_count(const Handle& attribute, const std::string& name) const;
  void read_attribute(const std::string& name, const Handle& attribute, hid_t type, void* out) const;

  Handle handle_;
  std::string path_;
};

/// Bytes of a file.
struct FileRange {
  std::uint64_t offset = 0, bytes = 0;
};

class Dataset : public Location {
 public:
  Dataset(hid_t id, std::string path) : Location(id, H5Dclose, std::move(path)) {}
  /// Where the values of a contiguous dataset lie.
  [[nodiscard]] FileRange range() const;
  /// Writes data, contiguous in memory, to the selected part of `where`, in the order of the file. In a
  /// collective transfer a rank with nothing to write passes no data and an empty selection.
  template <Number T>
  void write(std::span<const T> data, const Dataspace& where, Transfer transfer) const {
    write(Type::of<T>(), data.data(), where, transfer);
  }
  void write(const Type&, const void* data, const Dataspace& where, Transfer) const;
  template <Number T>
  void read(std::span<T> out, const Dataspace& where, Transfer transfer) const {
    read(Type::of<T>(), out.data(), out.size(), where, transfer);
  }
  /// The whole dataset, read by this rank alone.
  template <Number T>
  [[nodiscard]] std::vector<T> read_all() const {
    const Dataspace everything = space();
    std::vector<T> values(count());
    read(std::span(values), everything, Transfer::independent);
    return values;
  }
  /// Of the values. Throws if the file does not hold as many bytes: a damaged shape must not ask for all memory, nor have
  /// HDF5 read where nothing is.
  [[nodiscard]] std::size_t count() const;
  /// The shape, everything selected.
  [[nodiscard]] Dataspace space() const { return Dataspace::of_dataset(id(), path()); }

 private:
  void read(const Type&, void* out, std::size_t count, const Dataspace& where, Transfer) const;
};

/// Part of a virtual dataset: the selected part of `target` is found in the selected part of `source_space`
/// of the dataset `source` (an absolute path) of the same file.
struct Mapping {
  Dataspace target;
  std::string source;
  Dataspace source_space;
};

/// A place that holds groups and datasets.
class Group : public Location {
 public:
  Group(hid_t id, std::string path) : Location(id, H5Gclose, std::move(path)) {}
  [[nodiscard]] Group create_group(const std::string& name) const;
  [[nodiscard]] Group open_group(const std::string& name) const;
  /// Contiguous, allocated at once, never filled, without a time stamp.
  [[nodiscard]] Dataset create_dataset(const std::string& name, const Type&, const Dataspace&) const;
  void create_virtual_dataset(const std::string& name, const Type&, const Dataspace&,
                              std::span<const Mapping>) const;
  [[nodiscard]] Dataset open_dataset(const std::string& name) const;
  [[nodiscard]] bool has(const std::string& name) const;
  /// Of the groups and datasets in this one.
  [[nodiscard]] std::vector<std::string> names() const;

 protected:
  using Location::Location;

 private:
  [[nodiscard]] Dataset create_dataset(const std::string& name, const Type&, const Dataspace&,
                                       const Handle& properties) const;
};

/// What a file is opened for. Objects are created by one rank alone (File::create), ranks together only write
/// values: in 1.10 HDF5 duplicates the communicator for every virtual dataset that is created, and when its
/// own bookkeeping cannot be written on one rank the others wait forever.
enum class Access { read, write_values };

/// A file, and its root group.
class File : public Group {
 public:
  /// For this rank alone; replaces a file of this name. The first `room` bytes, 0 or a power of 2 from 512 on, are left
  /// to the caller.
  [[nodiscard]] static File create(const std::string& path, std::uint64_t room = 0);
  /// For this rank alone.
  [[nodiscard]] static File open(const std::string& path, Access);
  /// For all ranks of the communicator together, as is the closing of the file.
  [[nodiscard]] static File open(const std::string& path, Access, MPI_Comm);
  /// Every rank hands to the disk what it has written; only the rank that wrote can. Collective if the file is shared.
  void flush() const;
  /// Writes what HDF5 still holds back, so it may notice a full disk; the destructor closes too, but
  /// silently. All groups and datasets of the file must be gone by then.
  void close();

 private:
  using Group::Group;
};

/// Keeps a rank taking part in collective calls after it failed: if it left, the others would wait for it
/// forever. The first failure is remembered, and all ranks throw it once they have agreed on it.
class SharedFailure {
 public:
  /// Does the work unless this rank has failed already, and remembers its exception.
  template <class Work>
  void attempt(const std::string& path, const std::string& attempt, Work&& work) {
    if (failure_) return;
    try {
      work();
    } catch (const OutputError& error) {
      failure_ = error;
    } catch (const std::exception& error) {
      failure_ = OutputError(path, attempt, error.what());
    }
  }
  explicit operator bool() const { return failure_.has_value(); }
  /// Collective: throws on every rank the failure of the lowest rank that has one.
  void agree(MPI_Comm) const;

 private:
  std::optional<OutputError> failure_;
};

/// How items of equal size, such as the blocks of a level, are dealt out to the ranks.
struct Share {
  std::size_t items = 0;          ///< of all ranks
  std::size_t most = 0;           ///< items of the rank that has most
  std::vector<std::size_t> mine;  ///< this rank's, ascending
};

/// owner: the rank of every item, the same on all ranks.
[[nodiscard]] Share share_of(std::span<const int> owner, MPI_Comm);

/// Values a rank collects for one collective transfer, in bytes; one item if that is larger.
inline constexpr std::size_t kTransferBytes = std::size_t{64} << 20;

/// Collective: writes items of `length` values each to a one-dimensional dataset. produce(item, out) supplies
/// the values of an item this rank owns. Does not throw for one rank alone: `failure` remembers.
template <Number T, class Produce>
void write_items(const Dataset&, const Share&, std::size_t length, SharedFailure& failure,
                 const Produce& produce);

/// Takes disk space for an existing file, beyond its end, so that a full disk shows before the ranks depend
/// on each other, and before HDF5 has something to write that it cannot give up. Does nothing where the file
/// system cannot. Not collective.
void reserve_space(const std::string& path, std::uint64_t bytes);
/// Gives back what lies beyond the end of the file. Not collective.
void release_excess_space(const std::string& path);
/// Moves a complete file to its final name, file and name safe on the disk when it returns. Not collective.
void complete_file(const std::string& part, const std::string& path);
/// Removes what a failure left behind, if anything. Not collective.
void remove_quietly(const std::string& path) noexcept;

namespace detail {
/// HDF5's description of what failed last, and of the cause; clears it.
[[nodiscard]] std::string last_error();
/// Returns status if it is not negative, throws OutputError otherwise.
template <class Status>
Status check(Status status, const std::string& path, std::string_view attempt, std::string_view name = {}) {
  if (status >= 0) return status;
  std::string what(attempt);
  if (!name.empty()) what.append(" ").append(name);
  throw OutputError(path, std::move(what), last_error());
}
}  // namespace detail

template <Number T>
Type Type::of() {
  if constexpr (std::same_as<T, std::uint8_t>) return copy_of(H5T_NATIVE_UINT8);
  if constexpr (std::same_as<T, std::int32_t>) return copy_of(H5T_NATIVE_INT32);
  if constexpr (std::same_as<T, std::uint32_t>) return copy_of(H5T_NATIVE_UINT32);
  if constexpr (std::same_as<T, std::int64_t>) return copy_of(H5T_NATIVE_INT64);
  if constexpr (std::same_as<T, std::uint64_t>) return copy_of(H5T_NATIVE_UINT64);
  if constexpr (std::same_as<T, double>) return copy_of(H5T_NATIVE_DOUBLE);
}

template <Number T>
T Location::read_attribute(const std::string& name) const {
  const std::vector<T> values = read_attribute_list<T>(name);
  if (values.size() == 1) return values.front();
  throw OutputError(path_, "read attribute " + name,
                    "it has " + std::to_string(values.size()) + " values, not 1");
}

template <Number T>
std::vector<T> Location::read_attribute_list(const std::string& name) const {
  const Handle attribute = open_attribute(name);
  std::vector<T> values(attribute_count(attribute, name));
  read_attribute(name, attribute, Type::of<T>().id(), values.data());
  return values;
}

template <Number T, class Produce>
void write_items(const Dataset& dataset, const Share& share, std::size_t length, SharedFailure& failure,
                 const Produce& produce) {
  const std::size_t per_call = std::max<std::size_t>(1, kTransferBytes / (length * sizeof(T)));
  std::vector<T> buffer;
  failure.attempt(dataset.path(), "collect values",
                  [&] { buffer.resize(std::min(share.mine.size(), per_call) * length); });
  // Everyone makes as many transfers as the rank that has most to write.
  for (std::size_t done = 0; done < share.most; done += per_call) {
    const std::size_t first = std::min(done, share.mine.size());
    std::span<const std::size_t> items(share.mine.data() + first,
                                       std::min(per_call, share.mine.size() - first));
    failure.attempt(dataset.path(), "collect values", [&] {
      const std::span<T> out(buffer);
      for (std::size_t i = 0; i < items.size(); ++i) produce(items[i], out.subspan(i * length, length));
    });
    // A rank that failed has nothing to write, but still comes to the transfers of the others.
    if (failure) items = {};
    SharedFailure transfer;
    transfer.attempt(dataset.path(), "write values", [&] {
      Dataspace where = Dataspace::simple(share.items * length);
      where.select_items(items, length);
      dataset.write(std::span<const T>(buffer.data(), items.size() * length), where, Transfer::collective);
    });
    if (!failure) failure = transfer;
  }
}

}  // namespace dendrift::io

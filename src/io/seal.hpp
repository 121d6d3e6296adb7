/// \file
/// The seal of a checkpoint: a text in front of the HDF5 data that says which version wrote the file, how long it is, and
/// the checksum of all of it but the values of fields, which have checksums of their own. It is read before HDF5 sees the
/// file, because HDF5 may crash on damaged bookkeeping. Not collective: one rank writes and checks it.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>

#include "io/hdf5.hpp"

namespace dendrift::io {

/// Room that the seal takes at the beginning of the file.
[[nodiscard]] std::uint64_t seal_bytes(std::size_t value_ranges);

/// Seals a complete file. `values`: ascending, the parts that the seal leaves to other checksums.
void write_seal(const std::string& path, std::uint64_t room, int format, std::span<const FileRange> values);

/// The format of a sealed file that is intact outside its values; nothing if there is no seal. Of a format above `newest`
/// only the number is read. Throws OutputError that says what is wrong.
[[nodiscard]] std::optional<int> check_seal(const std::string& path, int newest);

}  // namespace dendrift::io

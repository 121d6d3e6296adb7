/// \file
/// Checksums of what a file holds.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace dendrift::io {

/// CRC-32 as in zlib and PNG, which other programs can compute too. `before`: that of the bytes in front of these.
[[nodiscard]] std::uint32_t crc32(std::span<const std::byte> bytes, std::uint32_t before = 0);

}  // namespace dendrift::io

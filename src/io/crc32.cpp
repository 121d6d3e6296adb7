#include "io/crc32.hpp"

#include <array>
#include <bit>
#include <cstring>

namespace dendrift::io {

namespace {

constexpr std::size_t WIDTH = 8;  // bytes taken at once, each with a table of its own

using Tables = std::array<std::array<std::uint32_t, 256>, WIDTH>;

constexpr Tables make_tables() {
  Tables t{};
  for (std::uint32_t i = 0; i < 256; ++i) {
    std::uint32_t c = i;
    for (int bit = 0; bit < 8; ++bit) c = (c & 1U) != 0 ? 0xEDB88320U ^ (c >> 1) : c >> 1;
    t[0][i] = c;
  }
  for (std::size_t k = 1; k < WIDTH; ++k)
    for (std::size_t i = 0; i < 256; ++i) t[k][i] = (t[k - 1][i] >> 8) ^ t[0][t[k - 1][i] & 0xFFU];
  return t;
}

constexpr Tables TABLES = make_tables();

std::uint32_t eight_bytes(const std::byte* p, std::uint32_t c) {
  static_assert(std::endian::native == std::endian::little);
  std::uint64_t word = 0;
  std::memcpy(&word, p, WIDTH);
  word ^= c;
  std::uint32_t sum = 0;
  for (std::size_t k = 0; k < WIDTH; ++k) sum ^= TABLES[WIDTH - 1 - k][(word >> (8 * k)) & 0xFFU];
  return sum;
}

}  // namespace

std::uint32_t crc32(std::span<const std::byte> bytes, std::uint32_t before) {
  std::uint32_t c = ~before;
  std::size_t i = 0;
  for (; i + WIDTH <= bytes.size(); i += WIDTH) c = eight_bytes(bytes.data() + i, c);
  for (; i < bytes.size(); ++i) c = TABLES[0][(c ^ std::to_integer<std::uint32_t>(bytes[i])) & 0xFFU] ^ (c >> 8);
  return ~c;
}

}  // namespace dendrift::io

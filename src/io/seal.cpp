#include "io/seal.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <sstream>
#include <string_view>
#include <vector>

#include "io/crc32.hpp"

namespace dendrift::io {

namespace {

constexpr std::string_view TITLE = "Dendrift checkpoint\n";
constexpr std::uint64_t MOST_ROOM = std::uint64_t{1} << 20;
constexpr std::size_t PIECE = std::size_t{4} << 20;  // bytes read at once

struct Seal {
  int format = 0;
  std::uint64_t room = 0, bytes = 0;
  std::vector<FileRange> values;
  std::uint32_t checksum = 0;
};

std::uint32_t crc32_of(std::string_view text, std::uint32_t before = 0) {
  return crc32(std::as_bytes(std::span(text.data(), text.size())), before);
}

// What the seal's own checksum covers, which follows in the last line.
std::string text_of(const Seal& seal) {
  std::string text = fmt::format("{}format {}\nroom {}\nbytes {}\n", TITLE, seal.format, seal.room, seal.bytes);
  for (const FileRange& v : seal.values) text += fmt::format("values {} {}\n", v.offset, v.bytes);
  return text + fmt::format("checksum {:08x}\n", seal.checksum);
}

class Reader {
 public:
  explicit Reader(const std::string& path) : path_(path), in_(path, std::ios::binary | std::ios::ate) {
    if (!in_) fail(std::strerror(errno));
    const auto end = in_.tellg();  // of a folder there is none
    if (end < 0) fail("it is not a file");
    size_ = static_cast<std::uint64_t>(end);
  }
  std::uint64_t size() const { return size_; }

  std::string text(std::uint64_t offset, std::uint64_t bytes) {
    std::string text(std::min(bytes, size_ - std::min(offset, size_)), '\0');
    in_.seekg(static_cast<std::streamoff>(offset));
    if (!in_.read(text.data(), static_cast<std::streamsize>(text.size()))) fail("it cannot be read");
    return text;
  }

  /// Of everything behind the seal but the values.
  std::uint32_t checksum(const Seal& seal) {
    std::uint32_t sum = 0;
    std::uint64_t at = seal.room;
    for (const FileRange& v : seal.values) {
      sum = checksum(at, v.offset, sum);
      at = v.offset + v.bytes;
    }
    return checksum(at, seal.bytes, sum);
  }

  [[noreturn]] void fail(const std::string& reason) const { throw OutputError(path_, "restart", reason); }

 private:
  std::uint32_t checksum(std::uint64_t begin, std::uint64_t end, std::uint32_t sum) {
    for (; begin < end; begin += PIECE) sum = crc32_of(text(begin, std::min<std::uint64_t>(PIECE, end - begin)), sum);
    return sum;
  }

  std::string path_;
  std::ifstream in_;
  std::uint64_t size_ = 0;
};

bool in_order(const Seal& seal) {
  std::uint64_t at = seal.room;
  for (const FileRange& v : seal.values) {
    if (v.offset < at || v.offset > seal.bytes || v.bytes > seal.bytes - v.offset) return false;
    at = v.offset + v.bytes;
  }
  return seal.room <= MOST_ROOM && at <= seal.bytes;
}

// The numbers of a seal; nothing if it is not word for word what write_seal writes.
std::optional<Seal> parse(const std::string& head) {
  Seal seal;
  std::istringstream in(head);
  std::string word;
  std::getline(in, word);
  std::uint32_t own = 0;
  in >> word >> seal.format >> word >> seal.room >> word >> seal.bytes;
  while (in >> word && word == "values") {
    FileRange v;
    in >> v.offset >> v.bytes;
    seal.values.push_back(v);
  }
  in >> std::hex >> seal.checksum >> word >> own;
  if (!in) return std::nullopt;
  const std::string text = text_of(seal);
  std::string expected = text + fmt::format("seal {:08x}\n", crc32_of(text));
  if (expected.size() > seal.room || seal.room > head.size()) return std::nullopt;
  expected.resize(seal.room, '\0');
  if (head.substr(0, seal.room) != expected || !in_order(seal)) return std::nullopt;
  return seal;
}

}  // namespace

std::uint64_t seal_bytes(std::size_t value_ranges) {
  return std::bit_ceil(256 + 64 * static_cast<std::uint64_t>(value_ranges));  // HDF5 wants a power of 2
}

void write_seal(const std::string& path, std::uint64_t room, int format, std::span<const FileRange> values) {
  Reader file(path);
  Seal seal{format, room, file.size(), {values.begin(), values.end()}, 0};
  seal.checksum = file.checksum(seal);
  std::string text = text_of(seal);
  text += fmt::format("seal {:08x}\n", crc32_of(text));
  if (text.size() > room) throw OutputError(path, "seal the file", "there is too little room in front of the data");
  text.resize(room, '\0');
  std::fstream out(path, std::ios::binary | std::ios::in | std::ios::out);
  out.write(text.data(), static_cast<std::streamsize>(text.size()));
  out.close();
  if (!out) throw OutputError(path, "seal the file", std::strerror(errno));
}

std::optional<int> check_seal(const std::string& path, int newest) {
  Reader file(path);
  if (file.size() == 0) file.fail("the file is empty");
  const std::string head = file.text(0, MOST_ROOM);
  if (!head.starts_with(TITLE)) return std::nullopt;
  int format = 0;
  if (std::sscanf(head.c_str() + TITLE.size(), "format %d", &format) == 1 && format > newest) return format;
  const std::optional<Seal> seal = parse(head);
  if (!seal) file.fail("the file is damaged: its seal, at the beginning, is not as it was written");
  if (file.size() != seal->bytes)
    file.fail(fmt::format("the file is {}: it has {} bytes, not {}", file.size() < seal->bytes ? "truncated" : "damaged",
                          file.size(), seal->bytes));
  if (file.checksum(*seal) != seal->checksum)
    file.fail("the file is damaged: what stands in it beside the values of fields has another checksum than it was written with");
  return seal->format;
}

}  // namespace dendrift::io

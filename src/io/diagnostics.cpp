#include "io/diagnostics.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "io/hdf5.hpp"

namespace dendrift::io {

std::string number_text(double x) {
  if (std::isfinite(x) && x == std::floor(x) && std::abs(x) < 1e15) return fmt::format("{:.0f}", x);
  return fmt::format("{}", x);
}

namespace {

void set_aside(const std::string& path) {
  std::string name = path + ".old";
  for (int i = 2; std::filesystem::exists(name); ++i) name = fmt::format("{}.old{}", path, i);
  std::error_code error;
  std::filesystem::rename(path, name, error);
  if (error) throw OutputError(path, "set the file aside, whose columns are those of another version", error.message());
}

// Complete lines of an earlier run whose time is not after `last_time`, header first.
std::string kept_lines(const std::string& path, std::string_view header, std::string_view time_column, double last_time) {
  std::string kept(header);
  kept += '\n';
  std::size_t column = 0;
  std::istringstream names{std::string(header)};
  for (std::string name; std::getline(names, name, ',') && name != time_column;) ++column;
  std::ifstream in(path);
  std::string text((std::istreambuf_iterator<char>(in)), {});
  text.erase(text.rfind('\n') == std::string::npos ? 0 : text.rfind('\n') + 1);  // a torn last line
  std::istringstream lines(text);
  std::string line;
  std::getline(lines, line);
  if (line != header) {  // another version's columns: they stay, under another name
    if (!text.empty()) set_aside(path);
    return kept;
  }
  while (std::getline(lines, line)) {
    std::istringstream cells(line);
    std::string cell;
    for (std::size_t i = 0; i <= column; ++i) std::getline(cells, cell, ',');
    if (std::strtod(cell.c_str(), nullptr) <= last_time * (1 + 1e-12)) kept += line + '\n';
  }
  return kept;
}

}  // namespace

CsvFile::CsvFile(std::string path, std::string_view header) : path_(std::move(path)) { start(std::string(header) + "\n"); }

CsvFile::CsvFile(std::string path, std::string_view header, std::string_view time_column, double last_time)
    : path_(std::move(path)) {
  start(kept_lines(path_, header, time_column, last_time));
}

CsvFile::~CsvFile() {
  if (file_ >= 0) ::close(file_);
}

void CsvFile::fail(const std::string& attempt, int error) const {
  throw OutputError(path_, attempt, error == 0 ? "another file has its name" : std::strerror(error));
}

// The lines from before a restart must not be lost to a kill while they are written again.
void CsvFile::start(std::string_view text) {
  const std::string part = path_ + ".part";
  try {
    file_ = ::open(part.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0666);
    if (file_ < 0) fail("create the file", errno);
    write(text);
    complete_file(part, path_);
  } catch (...) {
    if (file_ >= 0) ::close(file_);
    remove_quietly(part);
    throw;
  }
}

void CsvFile::write(std::string_view text) const {
  const off_t end = ::lseek(file_, 0, SEEK_END);
  while (!text.empty()) {
    const ssize_t count = ::write(file_, text.data(), text.size());
    if (count > 0) text.remove_prefix(static_cast<std::size_t>(count));
    if (count > 0 || (count < 0 && errno == EINTR)) continue;
    const int error = count < 0 ? errno : ENOSPC;
    if (end >= 0 && ::ftruncate(file_, end) != 0) {}  // a torn line: a restart leaves it out
    fail("write a line", error);
  }
}

// Lines for a file that was removed or moved away would be lost without a word.
void CsvFile::require_in_place() const {
  struct stat own {}, found {};
  if (::fstat(file_, &own) != 0 || ::stat(path_.c_str(), &found) != 0) fail("write a line", errno);
  if (own.st_ino != found.st_ino || own.st_dev != found.st_dev) fail("write a line", 0);
}

void CsvFile::sync() const {
  if (::fsync(file_) != 0) fail("bring lines to the disk", errno);
}

void CsvFile::line(const std::vector<double>& values) {
  std::string text;
  for (const double v : values) text += (text.empty() ? "" : ",") + number_text(v);
  require_in_place();
  write(text + "\n");
}

}  // namespace dendrift::io

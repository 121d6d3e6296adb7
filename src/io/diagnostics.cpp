#include "io/diagnostics.hpp"

#include <fmt/format.h>

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

CsvFile::CsvFile(std::string path, std::string_view header)
    : path_(std::move(path)), file_(std::fopen(path_.c_str(), "w")) {
  if (!file_) throw OutputError(path_, "create the file", std::strerror(errno));
  write(std::string(header) + "\n");
}

CsvFile::CsvFile(std::string path, std::string_view header, std::string_view time_column, double last_time)
    : path_(std::move(path)) {
  const std::string kept = kept_lines(path_, header, time_column, last_time);
  file_.reset(std::fopen(path_.c_str(), "w"));
  if (!file_) throw OutputError(path_, "continue the file", std::strerror(errno));
  write(kept);
}

void CsvFile::write(std::string_view text) {
  if (std::fwrite(text.data(), 1, text.size(), file_.get()) != text.size() || std::fflush(file_.get()) != 0)
    throw OutputError(path_, "write a line", std::strerror(errno));
}

void CsvFile::line(const std::vector<double>& values) {
  std::string text;
  for (const double v : values) text += (text.empty() ? "" : ",") + number_text(v);
  write(text + "\n");
}

}  // namespace dendrift::io

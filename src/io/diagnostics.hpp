/// \file
/// CSV files: one header line, then a line at a time, so that a killed run keeps what it had.
#pragma once

#include <string>
#include <string_view>
#include <vector>

namespace dendrift::io {

/// Not collective: one rank owns a file. Every failure throws OutputError; of a line that could not be written nothing stays.
class CsvFile {
 public:
  /// Starts the file anew.
  CsvFile(std::string path, std::string_view header);
  /// Continues a file after a restart: complete lines up to `last_time` in column `time_column` are kept.
  CsvFile(std::string path, std::string_view header, std::string_view time_column, double last_time);
  ~CsvFile();
  CsvFile(const CsvFile&) = delete;
  CsvFile& operator=(const CsvFile&) = delete;

  void line(const std::vector<double>& values);
  /// Brings the lines to the disk.
  void sync() const;

 private:
  void start(std::string_view text);
  void write(std::string_view text) const;
  void require_in_place() const;
  [[noreturn]] void fail(const std::string& attempt, int error) const;
  std::string path_;
  int file_ = -1;
};

/// Shortest text that reads back as the same number; integers without a point.
std::string number_text(double x);

}  // namespace dendrift::io

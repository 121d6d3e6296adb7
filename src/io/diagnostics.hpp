/// \file
/// CSV files: one header line, then a line at a time, so that a killed run keeps what it had.
#pragma once

#include <cstdio>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

namespace dendrift::io {

/// Not collective: one rank owns a file. Every failure throws OutputError.
class CsvFile {
 public:
  /// Starts the file anew.
  CsvFile(std::string path, std::string_view header);
  /// Continues a file after a restart: complete lines up to `last_time` in column `time_column` are kept.
  CsvFile(std::string path, std::string_view header, std::string_view time_column, double last_time);

  void line(const std::vector<double>& values);

 private:
  void write(std::string_view text);
  struct Close {
    void operator()(std::FILE* f) const { std::fclose(f); }
  };
  std::string path_;
  std::unique_ptr<std::FILE, Close> file_;
};

/// Shortest text that reads back as the same number; integers without a point.
std::string number_text(double x);

}  // namespace dendrift::io

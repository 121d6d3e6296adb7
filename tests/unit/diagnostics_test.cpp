// CSV files that a restart continues.
#include "io/diagnostics.hpp"

#include <gtest/gtest.h>

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <sstream>

#include "io/hdf5.hpp"

namespace dendrift::test {
namespace {

class CsvRestart : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::temp_directory_path() / ("dendrift_csv_" + std::to_string(::getpid()));
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }
  std::string path(const std::string& name = "a.csv") const { return (folder_ / name).string(); }
  void write(const std::string& text) const { std::ofstream(path()) << text; }
  std::string read(const std::string& name = "a.csv") const {
    std::stringstream text;
    text << std::ifstream(path(name)).rdbuf();
    return text.str();
  }

  std::filesystem::path folder_;
};

TEST_F(CsvRestart, KeepsLinesUpToTheCheckpoint) {
  write("n,t\n1,0.1\n2,0.2\n3,0.3\n4,0.");  // the last one torn
  { io::CsvFile(path(), "n,t", "t", 0.2).line({5, 0.25}); }
  EXPECT_EQ(read(), "n,t\n1,0.1\n2,0.2\n5,0.25\n");
}

TEST_F(CsvRestart, SetsOtherColumnsAside) {
  for (const std::string name : {"a.csv.old", "a.csv.old2"}) {
    write("t,n\n0.1,1\n");
    { io::CsvFile(path(), "n,t", "t", 0.2).line({5, 0.25}); }
    EXPECT_EQ(read(), "n,t\n5,0.25\n");
    EXPECT_EQ(read(name), "t,n\n0.1,1\n");
  }
}

TEST_F(CsvRestart, NoticesThatTheFileIsGone) {
  io::CsvFile file(path(), "n,t");
  file.line({1, 2});
  std::filesystem::rename(path(), path("moved.csv"));
  EXPECT_THROW(file.line({3, 4}), io::OutputError);
  write("n,t\n");  // another file of that name
  EXPECT_THROW(file.line({3, 4}), io::OutputError);
  EXPECT_EQ(read("moved.csv"), "n,t\n1,2\n");
}

TEST_F(CsvRestart, NothingBefore) {
  { io::CsvFile(path(), "n,t", "t", 0.2).line({5, 0.25}); }
  EXPECT_EQ(read(), "n,t\n5,0.25\n");
  EXPECT_FALSE(std::filesystem::exists(path("a.csv.old")));
}

}  // namespace
}  // namespace dendrift::test

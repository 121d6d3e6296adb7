// Checksums, the seal of a checkpoint, and what a restart changes. Whole runs: tests/clients/damage_test.py, restart_test.py.
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "io/config.hpp"
#include "io/crc32.hpp"
#include "io/seal.hpp"
#include "io/trial.hpp"
#include "physics/recall.hpp"
#include "physics/seeds.hpp"

namespace dendrift::test {
namespace {

std::uint32_t sum_of(const std::string& text, std::uint32_t before = 0) {
  return io::crc32(std::as_bytes(std::span(text)), before);
}

TEST(Crc32, IsThatOfZlib) {
  EXPECT_EQ(sum_of(""), 0U);
  EXPECT_EQ(sum_of("123456789"), 0xCBF43926U);  // the check value of the catalogue of CRCs
  EXPECT_EQ(sum_of("The quick brown fox jumps over the lazy dog"), 0x414FA339U);
}

TEST(Crc32, GoesOn) {
  const std::string text = "Dendrites grow in the direction of the steepest gradient.";
  for (std::size_t cut = 0; cut <= text.size(); ++cut)
    EXPECT_EQ(sum_of(text.substr(cut), sum_of(text.substr(0, cut))), sum_of(text)) << cut;
}

class SealTest : public ::testing::Test {
 protected:
  static constexpr std::size_t ROOM = 512;
  void SetUp() override {
    path_ = (std::filesystem::temp_directory_path() / ("dendrift_seal_" + std::to_string(::getpid()))).string();
    content_.assign(ROOM, '\0');
    for (int i = 0; i < 1000; ++i) content_ += static_cast<char>(i * 7);
    write(content_);
    io::write_seal(path_, ROOM, 2, values_);
    std::ifstream in(path_, std::ios::binary);
    content_.assign(std::istreambuf_iterator<char>(in), {});
  }
  void TearDown() override { std::filesystem::remove(path_); }
  void write(const std::string& content) const { std::ofstream(path_, std::ios::binary) << content; }
  bool refused(const std::string& content) const {
    write(content);
    try {
      return io::check_seal(path_, 2) != 2;
    } catch (const io::OutputError&) {
      return true;
    }
  }
  std::string path_, content_;
  std::vector<io::FileRange> values_{{600, 100}, {800, 56}};
};

TEST_F(SealTest, NoticesEveryByteButThoseOfValues) {
  for (std::size_t i = 0; i < content_.size(); ++i) {
    const bool value = (i >= 600 && i < 700) || (i >= 800 && i < 856);
    std::string changed = content_;
    changed[i] = static_cast<char>(changed[i] ^ 1);
    EXPECT_EQ(refused(changed), !value) << i;
  }
}

TEST_F(SealTest, NoticesOtherLengths) {
  EXPECT_FALSE(refused(content_));
  EXPECT_TRUE(refused(content_ + '\0'));
  for (std::size_t size = 0; size < content_.size(); size += 13) EXPECT_TRUE(refused(content_.substr(0, size))) << size;
}

TEST_F(SealTest, TellsOtherFiles) {
  write("something else");
  EXPECT_EQ(io::check_seal(path_, 2), std::nullopt);
  write("Dendrift checkpoint\nformat 3\nwhatever that has\n");
  EXPECT_EQ(io::check_seal(path_, 2), 3);
}

struct Scene {
  double a = 1;
  std::optional<double> b;
  std::vector<double> c;
  struct Seed {
    double r = 2;
  };
  std::vector<Seed> seeds;
  io::Schema schema;

  explicit Scene(const std::string& toml) {
    io::Table& t = schema.table("t", "t", io::Schema::Presence::implied);
    t.real("a", a);
    t.real("b", b);
    schema.table("u", "u").reals("c", c);
    schema.list("seed", "s", seeds, [](io::Table& table, Seed& s) { table.real("r", s.r); });
    schema.parse_text(toml, "scene", {});
  }
};

std::string changes(const std::string& before, const std::string& after) {
  std::string text;
  for (const io::InputChange& c : Scene(after).schema.changes_since(Scene(before).schema.resolved_toml()))
    text += c.key + ": " + c.before + " -> " + c.after + "; ";
  return text;
}

TEST(InputChanges, KeysTablesAndElements) {
  EXPECT_EQ(changes("[t]", "[t]\na = 1"), "");
  EXPECT_EQ(changes("[t]", "[t]\na = 3\nb = 4"), "t.a: 1.0 -> 3.0; t.b: unset -> 4.0; ");
  EXPECT_EQ(changes("[u]\nc = [1, 2]", "[t]"), "u: present -> absent; ");
  EXPECT_EQ(changes("[u]\nc = [1, 2]", "[u]\nc = [1, 3]"), "u.c: [1.0, 2.0] -> [1.0, 3.0]; ");
  EXPECT_EQ(changes("[[seed]]\n[[seed]]\nr = 3", "[[seed]]\n[[seed]]\n[[seed]]"),
            "seed[1].r: 3.0 -> 2.0; seed[2]: absent -> present; ");
}

TEST(InputChanges, KeysOfAnotherVersion) {
  const Scene scene("[t]\nb = 2");
  const auto known = scene.schema.changes_since("[t]\nb = 2.0\n");  // it did not know t.a, which has its default here
  EXPECT_TRUE(known.empty());
  const auto gone = scene.schema.changes_since("[t]\na = 1.0\nb = 2.0\nold = 5\n");
  ASSERT_EQ(gone.size(), 1U);
  EXPECT_EQ(gone[0].key + gone[0].before + gone[0].after, "t.old5unknown to this version");
}

TEST(Trial, SaysWhatKillsWork) {
  int there = 0;
  EXPECT_EQ(io::what_kills([&] { there = 1; }, 60), "");
  EXPECT_EQ(there, 0) << "a trial changes nothing here";
  EXPECT_EQ(io::what_kills([] { throw std::runtime_error("no"); }, 60), "");
  EXPECT_EQ(io::what_kills([] { std::raise(SIGSEGV); }, 60), "Segmentation fault");
  EXPECT_EQ(io::what_kills([] { std::abort(); }, 60), "Aborted");
  EXPECT_EQ(io::what_kills([] { _exit(7); }, 60), "it ends with exit code 7");
  EXPECT_EQ(io::what_kills([] { while (true) pause(); }, 1), "it takes more than 1 s");
}

// Found by libFuzzer: a count of a module that no int holds.
TEST(Memory, CountsThatNoIntHoldsAreRefused) {
  const std::vector<double> memory{3, -7, 1e10, -1e300, std::nan(""), std::numeric_limits<double>::infinity()};
  EXPECT_EQ(physics::remembered_count(memory, 0), 3);
  EXPECT_EQ(physics::remembered_count(memory, 1), -7);
  for (std::size_t i = 2; i < memory.size() + 1; ++i) EXPECT_THROW(physics::remembered_count(memory, i), std::out_of_range) << i;
  physics::Seed crystal;
  std::vector<double> of_crystal = physics::memory(crystal);
  physics::recall(crystal, of_crystal);
  of_crystal[of_crystal.size() - 4] = -1e308;  // contacts
  EXPECT_THROW(physics::recall(crystal, of_crystal), std::out_of_range);
}

}  // namespace
}  // namespace dendrift::test

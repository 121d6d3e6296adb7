#include "io/config.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <limits>
#include <optional>
#include <string>
#include <vector>

namespace dendrift::io {
namespace {

enum class Scheme { euler, rk2, rk4 };

struct Seed {
  double radius_um = 0.0;
  std::optional<std::array<double, 3>> position_um;
  std::string shape = "sphere";
};

struct Config {
  double width_um = 100.0, courant = 0.5, tilt = 0.0;
  std::optional<double> pull;
  int levels = 3;
  std::int64_t steps = 1000;
  std::optional<int> stop;
  bool restart = false;
  std::string dir = "out";
  std::optional<std::string> label;
  std::vector<double> times = {0.5, 1.0};
  std::vector<int> ranks;
  std::array<double, 2> origin = {0.0, 0.0};
  std::optional<std::array<double, 3>> axis;
  std::array<int, 3> cells = {8, 8, 8};
  std::optional<std::array<int, 2>> block;
  std::vector<std::string> fields = {"phi"};
  Scheme scheme = Scheme::rk2;
  double gradient = 0.0, speed = 1.0;
  std::vector<Seed> seeds;

  void declare(Schema& schema) {
    using Presence = Schema::Presence;
    Table& domain = schema.table("domain", "Size and resolution.", Presence::required);
    domain.real("width_um", width_um).unit("um").above(0).required().doc("Width of the box.");
    domain.integer("levels", levels).range(1, 12).doc("Refinement levels.");
    domain.reals("origin", origin).unit("um").doc("Lower corner.");
    domain.reals("axis", axis).doc("Growth axis.");
    domain.integers("cells", cells).at_least(1).doc("Coarse cells.");
    domain.integers("block", block).doc("Block size.");

    Table& time = schema.table("time", "Time stepping.", Presence::implied);
    time.real("courant", courant).above(0).below(1).doc("Courant number.");
    time.choice("scheme", scheme, {{"euler", Scheme::euler}, {"rk2", Scheme::rk2}, {"rk4", Scheme::rk4}})
        .doc("Integrator.");
    time.integer("steps", steps).at_least(0).doc("Number of steps.");
    time.integer("stop", stop).doc("Stop early.");

    Table& output = schema.table("output", "Files.", Presence::implied);
    output.text("dir", dir).doc("Folder.");
    output.text("label", label).doc("Label | tag.");
    output.boolean("restart", restart).doc("Write restarts.");
    output.reals("times", times).unit("s").at_least(0).doc("Output times.");
    output.integers("ranks", ranks).doc("Ranks that report.");
    output.texts("fields", fields).doc("Fields.");

    Table& thermal = schema.table("thermal", "Frozen temperature.");
    thermal.real("gradient", gradient).unit("K/um").required().doc("Gradient.");
    thermal.real("speed", speed).unit("um/s").at_most(1e6).doc("Pulling speed.");
    thermal.real("tilt", tilt).allow_infinite().doc("Tilt.");
    thermal.real("pull", pull).doc("Extra pull.");

    schema.list<Seed>("seed", "Initial nuclei.", seeds, [](Table& table, Seed& seed) {
      table.real("radius_um", seed.radius_um).unit("um").above(0).required().doc("Radius.");
      table.reals("position_um", seed.position_um).unit("um").doc("Centre.");
      table.text("shape", seed.shape).doc("Shape.");
    });
  }
};

/// A config with its schema; parse() returns the issues.
struct Input {
  Config config;
  Schema schema;
  std::string what;

  Input() { config.declare(schema); }

  std::vector<InputIssue> parse(const std::string& text, const std::vector<std::string>& overrides = {}) {
    try {
      schema.parse_text(text, "run.toml", overrides);
    } catch (const InputError& error) {
      what = error.what();
      return error.issues();
    }
    return {};
  }

  std::vector<InputIssue> parse_file(const std::string& path) {
    try {
      schema.parse(path);
    } catch (const InputError& error) {
      what = error.what();
      return error.issues();
    }
    return {};
  }
};

const std::string minimal = "[domain]\nwidth_um = 10.0\n";

/// The only issue of `text`, which must have exactly one.
InputIssue only_issue(const std::string& text, const std::vector<std::string>& overrides = {}) {
  Input input;
  const auto issues = input.parse(text, overrides);
  EXPECT_EQ(issues.size(), 1u) << text.substr(0, 200) << "\n" << input.what;
  return issues.empty() ? InputIssue{} : issues.front();
}

void expect_issue(const InputIssue& issue, const std::string& where, const std::string& key,
                  const std::string& expected, const std::string& found) {
  EXPECT_EQ(issue.where, where);
  EXPECT_EQ(issue.key, key);
  EXPECT_EQ(issue.expected, expected);
  EXPECT_EQ(issue.found, found);
}

class File {
 public:
  explicit File(const std::string& content)
      : path_(std::filesystem::path(testing::TempDir()) /
              (std::string(testing::UnitTest::GetInstance()->current_test_info()->name()) + ".toml")) {
    std::ofstream(path_, std::ios::binary) << content;
  }
  File(const File&) = delete;
  File& operator=(const File&) = delete;
  ~File() { std::filesystem::remove(path_); }
  std::string path() const { return path_.string(); }

 private:
  std::filesystem::path path_;
};

// ---- accepted input ----

TEST(Config, ReadsEveryType) {
  Input input;
  const auto issues = input.parse(R"(
[domain]
width_um = 12.5
levels = 4
origin = [1, -2.5]       # an integer is a real
axis = [0.0, 0.0, 1.0]
cells = [16, 32, 0x40]
block = [4, 4]
[time]
courant = 0.25
scheme = "rk4"
steps = 9_000_000_000
stop = -3
[output]
dir = 'plots/a'
label = "first"
restart = true
times = [
  1e-3,
  2,
]
ranks = [0, 7]
fields = ["c", "T"]
[thermal]
gradient = 3
tilt = -inf
pull = 1e3
[[seed]]
radius_um = 1
position_um = [1, 2, 3]
[[seed]]
radius_um = 2.5
shape = "cube"
)");
  ASSERT_TRUE(issues.empty()) << input.what;
  const Config& c = input.config;
  EXPECT_EQ(c.width_um, 12.5);
  EXPECT_EQ(c.levels, 4);
  EXPECT_EQ(c.origin, (std::array{1.0, -2.5}));
  EXPECT_EQ(c.axis, (std::array{0.0, 0.0, 1.0}));
  EXPECT_EQ(c.cells, (std::array{16, 32, 64}));
  EXPECT_EQ(c.block, (std::array{4, 4}));
  EXPECT_EQ(c.courant, 0.25);
  EXPECT_EQ(c.scheme, Scheme::rk4);
  EXPECT_EQ(c.steps, 9'000'000'000);
  EXPECT_EQ(c.stop, -3);
  EXPECT_EQ(c.dir, "plots/a");
  EXPECT_EQ(c.label, "first");
  EXPECT_TRUE(c.restart);
  EXPECT_EQ(c.times, (std::vector{1e-3, 2.0}));
  EXPECT_EQ(c.ranks, (std::vector{0, 7}));
  EXPECT_EQ(c.fields, (std::vector<std::string>{"c", "T"}));
  EXPECT_EQ(c.gradient, 3.0);
  EXPECT_EQ(c.tilt, -std::numeric_limits<double>::infinity());
  EXPECT_EQ(c.pull, 1e3);
  ASSERT_EQ(c.seeds.size(), 2u);
  EXPECT_EQ(c.seeds[0].radius_um, 1.0);
  EXPECT_EQ(c.seeds[0].position_um, (std::array{1.0, 2.0, 3.0}));
  EXPECT_EQ(c.seeds[0].shape, "sphere");
  EXPECT_EQ(c.seeds[1].radius_um, 2.5);
  EXPECT_FALSE(c.seeds[1].position_um);
  EXPECT_EQ(c.seeds[1].shape, "cube");
}

TEST(Config, KeepsDefaultsAndKnowsWhatWasGiven) {
  Input input;
  ASSERT_TRUE(input.parse("[domain]\nwidth_um = 10\nlevels = 3\n[[seed]]\nradius_um = 1\n").empty())
      << input.what;
  EXPECT_EQ(input.config.courant, 0.5);
  EXPECT_EQ(input.config.times, (std::vector{0.5, 1.0}));
  EXPECT_FALSE(input.config.label);
  EXPECT_TRUE(input.schema.has_table("domain"));
  EXPECT_TRUE(input.schema.has_table("seed"));
  EXPECT_FALSE(input.schema.has_table("time"));
  EXPECT_FALSE(input.schema.has_table("thermal"));
  EXPECT_TRUE(input.schema.given("domain.levels"));
  EXPECT_FALSE(input.schema.given("domain.cells"));
  EXPECT_TRUE(input.schema.given("seed[0].radius_um"));
  EXPECT_FALSE(input.schema.given("seed[0].shape"));
}

TEST(Config, AcceptsOtherSpellingsOfTheSameTree) {
  Input input;
  ASSERT_TRUE(
      input.parse("domain.width_um = 3\nseed = [{radius_um = 1}, {radius_um = 2}]\ntime = {courant = 0.1}\n")
          .empty())
      << input.what;
  EXPECT_EQ(input.config.width_um, 3.0);
  EXPECT_EQ(input.config.courant, 0.1);
  EXPECT_EQ(input.config.seeds.size(), 2u);
  Input with_bom_and_crlf;
  EXPECT_TRUE(with_bom_and_crlf.parse("\xEF\xBB\xBF[domain]\r\nwidth_um = 4\r\n").empty())
      << with_bom_and_crlf.what;
  EXPECT_EQ(with_bom_and_crlf.config.width_um, 4.0);
}

TEST(Config, ListReplacesWhatTheVectorHeld) {
  Input input;
  input.config.seeds.resize(5);
  ASSERT_TRUE(input.parse(minimal + "[[seed]]\nradius_um = 1\n").empty()) << input.what;
  EXPECT_EQ(input.config.seeds.size(), 1u);
  Input none;
  none.config.seeds.resize(5);
  ASSERT_TRUE(none.parse(minimal).empty()) << none.what;
  EXPECT_TRUE(none.config.seeds.empty());
}

// ---- one issue of each kind ----

TEST(Config, WrongTypes) {
  const std::string head = minimal;  // two lines: the next key is on line 3
  expect_issue(only_issue(head + "levels = 3.0"), "run.toml:3", "domain.levels", "integer in [1, 12]",
               "real number 3.0");
  expect_issue(only_issue(head + "levels = true"), "run.toml:3", "domain.levels", "integer in [1, 12]",
               "true");
  expect_issue(only_issue("[domain]\nwidth_um = true"), "run.toml:2", "domain.width_um",
               "finite real number > 0 um", "true");
  expect_issue(only_issue("[domain]\nwidth_um = \"wide\""), "run.toml:2", "domain.width_um",
               "finite real number > 0 um", "text \"wide\"");
  expect_issue(only_issue("[domain]\nwidth_um = 2024-01-01"), "run.toml:2", "domain.width_um",
               "finite real number > 0 um", "a date or time");
  expect_issue(only_issue("[domain]\nwidth_um = {}"), "run.toml:2", "domain.width_um",
               "finite real number > 0 um", "a table");
  expect_issue(only_issue(head + "[output]\nrestart = 1"), "run.toml:4", "output.restart", "true or false",
               "integer 1");
  expect_issue(only_issue(head + "[output]\ndir = 7"), "run.toml:4", "output.dir", "text", "integer 7");
  expect_issue(only_issue(head + "[output]\ntimes = 1.0"), "run.toml:4", "output.times",
               "list of finite real numbers, each >= 0 s", "real number 1.0");
  expect_issue(only_issue(head + "[output]\nfields = [\"a\", 1]"), "run.toml:4", "output.fields[1]",
               "list of texts", "integer 1");
}

TEST(Config, Ranges) {
  expect_issue(only_issue("[domain]\nwidth_um = 0"), "run.toml:2", "domain.width_um",
               "finite real number > 0 um", "integer 0");
  expect_issue(only_issue(minimal + "levels = 13"), "run.toml:3", "domain.levels", "integer in [1, 12]",
               "integer 13");
  expect_issue(only_issue(minimal + "[time]\ncourant = 1.0"), "run.toml:4", "time.courant",
               "finite real number in (0, 1)", "real number 1.0");
  expect_issue(only_issue(minimal + "[time]\nsteps = -1"), "run.toml:4", "time.steps", "integer >= 0",
               "integer -1");
  expect_issue(only_issue(minimal + "[thermal]\ngradient = 1\nspeed = 1e7"), "run.toml:5", "thermal.speed",
               "finite real number <= 1000000 um/s", "real number 10000000.0");
  expect_issue(only_issue(minimal + "[output]\ntimes = [\n1.0,\n-1.0]"), "run.toml:6", "output.times[1]",
               "list of finite real numbers, each >= 0 s", "real number -1.0");
}

TEST(Config, EndsOfRangesBelongToThem) {
  Input input;
  ASSERT_TRUE(input.parse("[domain]\nwidth_um = 5e-324\nlevels = 12\n[time]\nsteps = 0\n").empty())
      << input.what;
  EXPECT_EQ(input.config.width_um, std::numeric_limits<double>::denorm_min());
}

TEST(Config, FixedLengths) {
  expect_issue(only_issue(minimal + "origin = [1.0]"), "run.toml:3", "domain.origin",
               "list of 2 finite real numbers in um", "a list of 1");
  expect_issue(only_issue(minimal + "axis = []"), "run.toml:3", "domain.axis",
               "list of 3 finite real numbers", "a list of 0");
  expect_issue(only_issue(minimal + "cells = [1, 2, 3, 4]"), "run.toml:3", "domain.cells",
               "list of 3 integers, each >= 1", "a list of 4");
}

TEST(Config, NonFinite) {
  for (const std::string value : {"nan", "inf", "-inf"}) {
    const auto issue = only_issue("[domain]\nwidth_um = " + value);
    EXPECT_EQ(issue.expected, "finite real number > 0 um");
    EXPECT_EQ(issue.found, "real number " + value);
  }
  EXPECT_EQ(only_issue(minimal + "origin = [0, nan]").key, "domain.origin[1]");
  const auto nan = only_issue(minimal + "[thermal]\ngradient = 1\ntilt = nan");
  EXPECT_EQ(nan.expected, "real number");  // infinite is allowed there, nan never
}

TEST(Config, IntegerOverflow) {
  const auto narrow = only_issue(minimal + "[time]\nstop = 2147483648");
  expect_issue(narrow, "run.toml:4", "time.stop", "integer", "integer 2147483648");
  EXPECT_NE(narrow.hint.find("32 bits"), std::string::npos);
  EXPECT_EQ(only_issue(minimal + "block = [1, -2147483649]").key, "domain.block[1]");
  const auto wide = only_issue(minimal + "[time]\nsteps = 9223372036854775808");
  EXPECT_EQ(wide.where, "run.toml:4");
  EXPECT_EQ(wide.expected, "valid TOML");
  EXPECT_EQ(only_issue("[domain]\nwidth_um = 1e999").where, "run.toml:2");
}

TEST(Config, Choices) {
  const auto issue = only_issue(minimal + "[time]\nscheme = \"rk3\"");
  expect_issue(issue, "run.toml:4", "time.scheme", "one of euler, rk2, rk4", "text \"rk3\"");
  EXPECT_EQ(issue.hint, "did you mean rk2?");
  EXPECT_EQ(only_issue(minimal + "[time]\nscheme = 4").found, "integer 4");
}

TEST(Config, UnknownKeysAndTables) {
  const auto near = only_issue(minimal + "levls = 3");
  expect_issue(near, "run.toml:3", "domain.levls", "a known key", "integer 3");
  EXPECT_EQ(near.hint, "did you mean levels?");
  EXPECT_EQ(only_issue(minimal + "Levels = 3").hint, "did you mean levels?");
  EXPECT_EQ(only_issue(minimal + "courant = 0.3").hint, "courant is a key of [time]");
  EXPECT_EQ(only_issue(minimal + "zzzzzzzzz = 3").hint,
            "[domain] has the keys width_um, levels, origin, axis, cells, block");
  const auto table = only_issue(minimal + "[themal]\ngradient = 1");
  expect_issue(table, "run.toml:3", "themal", "a known table", "a table");
  EXPECT_EQ(table.hint, "did you mean thermal?");
  EXPECT_EQ(only_issue(minimal + "[[seeds]]\nradius_um = 1").hint, "did you mean seed?");
  EXPECT_EQ(only_issue(minimal + "[qqqqqqqqq]").hint, "the tables are domain, time, output, thermal, seed");
  EXPECT_EQ(only_issue(minimal + "[domain.extra]\nx = 1").key, "domain.extra");
  const auto loose = only_issue("levels = 2\n" + minimal);
  expect_issue(loose, "run.toml:1", "levels", "a table (keys belong in tables)", "integer 2");
  EXPECT_EQ(loose.hint, "levels is a key of [domain]");
  EXPECT_EQ(only_issue(minimal + "[[seed]]\nradius_um = 1\nradius = 2").key, "seed[0].radius");
  EXPECT_EQ(only_issue(minimal + "\"a\\nb c\" = 2").key, "domain.\"a\\u000Ab c\"");
}

TEST(Config, MissingTablesAndKeys) {
  expect_issue(only_issue("[time]\nsteps = 1"), "run.toml", "domain", "a table [domain]", "nothing");
  const auto key = only_issue("\n[domain]\nlevels = 2");
  expect_issue(key, "run.toml", "domain.width_um", "finite real number > 0 um", "nothing");
  EXPECT_EQ(key.hint, "domain is at run.toml:2");
  EXPECT_EQ(only_issue(minimal + "[thermal]\nspeed = 1").key, "thermal.gradient");
  const auto item = only_issue(minimal + "[[seed]]\nradius_um = 1\n[[seed]]\nshape = \"a\"\n");
  EXPECT_EQ(item.key, "seed[1].radius_um");
  EXPECT_EQ(item.hint, "seed[1] is at run.toml:5");
}

TEST(Config, TableWhereListIsWantedAndBack) {
  expect_issue(only_issue(minimal + "[seed]\nradius_um = 1"), "run.toml:3", "seed",
               "a list of tables [[seed]]", "a table");
  expect_issue(only_issue("[[domain]]\nwidth_um = 1"), "run.toml:1", "domain", "one table [domain]",
               "a list of 1");
  expect_issue(only_issue("seed = [1]\n" + minimal), "run.toml:1", "seed[0]", "a table", "integer 1");
  expect_issue(only_issue("time = 3\n" + minimal), "run.toml:1", "time", "one table [time]", "integer 3");
}

TEST(Config, RequiredListAndImpliedTable) {
  std::vector<Seed> seeds;
  double x = 0.0;
  Schema schema;
  schema.list(
      "seed", "", seeds, [](Table& table, Seed& seed) { table.real("r", seed.radius_um); },
      Schema::Presence::required);
  schema.table("t", "", Schema::Presence::implied).real("x", x).required();
  try {
    schema.parse_text("seed = []", "a.toml");
    FAIL();
  } catch (const InputError& error) {
    ASSERT_EQ(error.issues().size(), 2u);
    expect_issue(error.issues()[0], "a.toml", "seed", "at least one [[seed]]", "nothing");
    expect_issue(error.issues()[1], "a.toml", "t.x", "finite real number", "nothing");
    EXPECT_EQ(error.issues()[1].hint, "");
  }
}

TEST(Config, SyntaxErrorsCarryTheirLine) {
  for (const std::string line : {"levels = ",
                                 "width_um = 4",
                                 "[domain]",
                                 "[[domain]]",
                                 "dir = \"a\nb\"",
                                 "[thermal",
                                 "x = 01",
                                 "x = \"\xFF\xFE\"",
                                 "# \xB5m",
                                 "x = 1 y = 2",
                                 "[.a]",
                                 "[a..b]",
                                 "[=]",
                                 "[#]",
                                 "[]",
                                 "x = .5",
                                 "x = 1e",
                                 "= 1",
                                 "x",
                                 "x = {a = 1,}",
                                 "x = \"\\q\"",
                                 "x = 1__0",
                                 "\x01 = 1"}) {
    const auto issue = only_issue(minimal + line + "\nlevels = 3\n");
    EXPECT_EQ(issue.where, "run.toml:3") << line;
    EXPECT_EQ(issue.expected, "valid TOML") << line;
    EXPECT_FALSE(issue.found.empty());
  }
}

TEST(Config, NonAsciiBelongsInTextsAndComments) {
  for (const std::string line : {"\u00B5 = 1", "[\u00B5]", "levels\u00A0= 3", "dir = \u201Ca\u201D", "\xFF",
                                 "x = {\u00E9 = 1}", "\"\"\"a\"\"\"\"\u00E9"})
    expect_issue(only_issue(minimal + "# \u00B5m\nlevels = 3 # \u00E9 ' \"\n" + line), "run.toml:5", "",
                 "only ASCII outside texts and comments", only_issue(minimal + line).found);
  Input input;
  const std::string text = "label = '\u00B5 \"'\ndir = \"\"\"\n\u00E9 \"\u00A0\" \\\n\n  a\"\"\"\n";
  ASSERT_TRUE(input.parse(minimal + "[output]\n" + text).empty()) << input.what;
  EXPECT_EQ(input.config.label, "\u00B5 \"");
  EXPECT_EQ(input.config.dir, "\u00E9 \"\u00A0\" a");
  const auto broken = only_issue(minimal + "[output]\ndir = \"\"\"a \\\n\n \u00E9\"\"\"\n");
  EXPECT_EQ(broken.where, "run.toml:6");
  EXPECT_EQ(broken.expected, "only ASCII right after a broken line");
}

// ---- all at once ----

TEST(Config, ReportsEverythingAtOnceInFileOrder) {
  Input input;
  const auto issues = input.parse(
      "[domain]\n"           // 1
      "widht_um = 10.0\n"    // 2 unknown
      "levels = 99\n"        // 3 range
      "cells = [1, 2]\n"     // 4 length
      "[output]\n"           // 5
      "restart = \"yes\"\n"  // 6 type
      "[time]\n"             // 7
      "scheme = \"rk5\"\n"   // 8 choice
      "[tmie]\n"             // 9 unknown table
      "[[seed]]\n"           // 10
      "radius_um = -1.0\n",  // 11 range
      {"time.steps=abc", "output.folder=x", "nonsense"});
  const std::vector<std::pair<std::string, std::string>> wanted = {
      {"run.toml:2", "domain.widht_um"},    {"run.toml:3", "domain.levels"},  {"run.toml:4", "domain.cells"},
      {"run.toml:6", "output.restart"},     {"run.toml:8", "time.scheme"},    {"run.toml:9", "tmie"},
      {"run.toml:11", "seed[0].radius_um"}, {"run.toml", "domain.width_um"},  {"command line", ""},
      {"command line", "time.steps"},       {"command line", "output.folder"}};
  ASSERT_EQ(issues.size(), wanted.size()) << input.what;
  for (std::size_t i = 0; i < wanted.size(); ++i) {
    EXPECT_EQ(issues[i].where, wanted[i].first);
    EXPECT_EQ(issues[i].key, wanted[i].second);
  }
  EXPECT_EQ(input.what.find("11 problems in the input\n"), 0u) << input.what;
  EXPECT_NE(input.what.find("run.toml:2: domain.widht_um\n"), std::string::npos) << input.what;
  EXPECT_NE(input.what.find("did you mean width_um?"), std::string::npos) << input.what;
  EXPECT_EQ(input.config.levels, 3);  // a rejected value is not stored
}

TEST(Config, ManyIssuesAreAllKeptButNotAllPrinted) {
  std::string text = minimal;
  for (int i = 0; i < 500; ++i) text.append("k").append(std::to_string(i)).append(" = 1\n");
  Input input;
  EXPECT_EQ(input.parse(text).size(), 500u);
  EXPECT_NE(input.what.find("and 400 more"), std::string::npos);
}

TEST(Config, ErrorCanBeCopiedAndSlicedToRuntimeError) {
  const InputError error({{"a", "b", "c", "d", "e"}});
  const InputError copy = error;
  EXPECT_EQ(copy.issues().size(), 1u);
  EXPECT_EQ(std::string(copy.what()),
            "1 problem in the input\n\na: b\n  expected: c\n  found:    d\n  hint:     e");
}

// ---- cross-key checks ----

TEST(Config, ChecksFindTheirLine) {
  Input input;
  input.schema.check([&](Checks& checks) {
    checks.fail("domain.levels", "fewer levels");
    checks.fail("domain.cells", "more cells");
    checks.fail("thermal.gradient", "a gradient", "none at all");
    checks.fail("domain", "another domain");
    EXPECT_TRUE(checks.given("domain.levels"));
    EXPECT_FALSE(checks.given("domain.cells"));
    EXPECT_FALSE(checks.has_table("thermal"));
  });
  input.schema.check([](Checks& checks) { checks.fail("seed[1].shape", "a cube"); });
  const auto issues = input.parse(minimal + "levels = 4\n[[seed]]\nradius_um = 1\n[[seed]]\nradius_um = 1\n");
  ASSERT_EQ(issues.size(), 5u) << input.what;
  expect_issue(issues[0], "run.toml:1", "domain.cells", "more cells", "nothing (default [8, 8, 8])");
  expect_issue(issues[1], "run.toml:1", "domain", "another domain", "a table");
  expect_issue(issues[2], "run.toml:3", "domain.levels", "fewer levels", "integer 4");
  expect_issue(issues[3], "run.toml:6", "seed[1].shape", "a cube", "nothing (default \"sphere\")");
  expect_issue(issues[4], "run.toml", "thermal.gradient", "a gradient", "none at all");
}

TEST(Config, ChecksFindTheCommandLine) {
  Input input;
  input.schema.check([](Checks& checks) { checks.fail("domain.levels", "fewer levels"); });
  const auto issues = input.parse(minimal + "levels = 4", {"domain.levels=5"});
  ASSERT_EQ(issues.size(), 1u);
  expect_issue(issues[0], "command line", "domain.levels", "fewer levels", "integer 5");
}

TEST(Config, ChecksRunOnlyOnSoundInput) {
  Input input;
  int anything = 0, domain = 0, levels = 0, output = 0, seed = 0;
  input.schema.check([&](Checks&) { ++anything; });
  input.schema.check({"domain"}, [&](Checks&) { ++domain; });
  input.schema.check({"domain.levels", "time"}, [&](Checks&) { ++levels; });
  input.schema.check({"output", "domain.width_um"}, [&](Checks& checks) {
    ++output;
    checks.fail("output.dir", "another folder");
  });
  input.schema.check({"seed"}, [&](Checks&) { ++seed; });
  const auto issues = input.parse(minimal + "levels = 99\n[[seed]]\nradius_um = 0\n");
  EXPECT_EQ(issues.size(), 3u) << input.what;
  EXPECT_EQ(anything, 0);
  EXPECT_EQ(domain, 0);
  EXPECT_EQ(levels, 0);
  EXPECT_EQ(output, 1);
  EXPECT_EQ(seed, 0);
}

// ---- overrides ----

TEST(Config, OverridesWinOverTheFile) {
  Input input;
  ASSERT_TRUE(input
                  .parse(minimal + "levels = 4\n",
                         {"domain.levels=5", "domain.levels = 6", "domain.cells=[1,2,3]", "time.scheme=rk4",
                          "time.courant=0.125", "output.dir=foo/bar", "output.restart=true",
                          "output.label=\"a = b\"", "output.fields=[\"x\"]"})
                  .empty())
      << input.what;
  EXPECT_EQ(input.config.levels, 6);  // the last one wins
  EXPECT_EQ(input.config.cells, (std::array{1, 2, 3}));
  EXPECT_EQ(input.config.scheme, Scheme::rk4);
  EXPECT_EQ(input.config.courant, 0.125);
  EXPECT_EQ(input.config.dir, "foo/bar");
  EXPECT_TRUE(input.config.restart);
  EXPECT_EQ(input.config.label, "a = b");
  EXPECT_EQ(input.config.fields, (std::vector<std::string>{"x"}));
  EXPECT_TRUE(input.schema.given("time.scheme"));
}

TEST(Config, BareTextsOnTheCommandLine) {
  for (const std::string value :
       {"2024", "true", "a b", "a=b", "a\"b\\", "1e3", "nan", "x # y", "", "a\nv = 3"}) {
    Input input;
    ASSERT_TRUE(input.parse(minimal, {"output.dir=" + value}).empty()) << input.what;
    EXPECT_EQ(input.config.dir, value);
  }
  EXPECT_EQ(only_issue(minimal, {"output.dir=\xFF"}).where, "command line");
}

TEST(Config, OverridesCreateTables) {
  Input input;
  ASSERT_TRUE(input.parse("# nothing here\n", {"domain.width_um=3", "thermal.gradient=1"}).empty())
      << input.what;
  EXPECT_TRUE(input.schema.has_table("thermal"));
  EXPECT_EQ(input.config.width_um, 3.0);
}

TEST(Config, OverridesOfListElements) {
  Input input;
  ASSERT_TRUE(input
                  .parse(minimal + "[[seed]]\nradius_um = 1\n[[seed]]\nradius_um = 1\n",
                         {"seed[1].radius_um=3", "seed[0].shape=cube", "seed[2].radius_um=4"})
                  .empty())
      << input.what;
  ASSERT_EQ(input.config.seeds.size(), 3u);
  EXPECT_EQ(input.config.seeds[0].shape, "cube");
  EXPECT_EQ(input.config.seeds[1].radius_um, 3.0);
  EXPECT_EQ(input.config.seeds[2].radius_um, 4.0);
  Input fresh;
  ASSERT_TRUE(fresh.parse(minimal, {"seed[0].radius_um=7"}).empty()) << fresh.what;
  EXPECT_EQ(fresh.config.seeds.at(0).radius_um, 7.0);
}

TEST(Config, BadOverridesNameTheCommandLine) {
  for (const std::string text :
       {"", "=", "domain", "domain=3", "domain.levels", ".levels=3", "domain.=3", "domain.levels.x=3",
        "seed[].radius_um=3", "seed[-1].radius_um=3", "seed[0.radius_um=3", "seed[0]radius_um=3",
        "seed[0]x.radius_um=3", "seed[9999999].radius_um=3", "do main.levels=3"}) {
    const auto issue = only_issue(minimal, {text});
    EXPECT_EQ(issue.where, "command line") << text;
    EXPECT_EQ(issue.expected, "table.key=value or list[i].key=value") << text;
  }
  expect_issue(only_issue(minimal, {"domain.levels=99"}), "command line", "domain.levels",
               "integer in [1, 12]", "integer 99");
  expect_issue(only_issue(minimal, {"domain.levels=three"}), "command line", "domain.levels",
               "integer in [1, 12]", "text \"three\"");
  expect_issue(only_issue(minimal, {"domain.levels="}), "command line", "domain.levels", "integer in [1, 12]",
               "text \"\"");
  EXPECT_EQ(only_issue(minimal, {"domain.levls=3"}).hint, "did you mean levels?");
  EXPECT_EQ(only_issue(minimal, {"domian.levels=3"}).hint, "did you mean domain?");
  expect_issue(only_issue(minimal, {"seed.radius_um=3"}), "command line", "seed.radius_um",
               "seed[i].radius_um", "no index");
  expect_issue(only_issue(minimal, {"domain[0].levels=3"}), "command line", "domain.levels", "domain.levels",
               "an index");
  expect_issue(only_issue(minimal, {"seed[1].radius_um=3"}), "command line", "seed[1].radius_um",
               "an index from 0 to 0 (which appends)", "1");
  EXPECT_EQ(only_issue("seed = 3\n" + minimal, {"seed[0].radius_um=3"}).where, "run.toml:1");
  EXPECT_EQ(only_issue("time = 3\n" + minimal, {"time.steps=3"}).where, "run.toml:1");
}

// ---- files ----

TEST(Config, ReadsFiles) {
  const File file(minimal + "levels = 13");
  Input input;
  const auto issues = input.parse_file(file.path());
  ASSERT_EQ(issues.size(), 1u);
  EXPECT_EQ(issues[0].where, file.path() + ":3");
}

TEST(Config, RejectsWhatIsNotAnInputFile) {
  const auto issue = [](const std::string& path) {
    Input input;
    const auto issues = input.parse_file(path);
    EXPECT_EQ(issues.size(), 1u) << input.what;
    return issues.empty() ? InputIssue{} : issues.front();
  };
  const std::string folder = testing::TempDir();
  expect_issue(issue(folder), folder, "", "a file", "a folder");
  const std::string absent = folder + "/no_such_input.toml";
  expect_issue(issue(absent), absent, "", "a readable file", "No such file or directory");
  EXPECT_EQ(issue("").expected, "a readable file");
  {
    const File file(" \n\t\n");
    expect_issue(issue(file.path()), file.path(), "", "at least one [table]", "an empty file");
  }
  {
    const File file("[domain]\nwidth" + std::string(1, '\0') + " = 1\n");
    EXPECT_EQ(issue(file.path()).where, file.path() + ":2");
  }
  {
    const File file(std::string((std::size_t{16} << 20) + 1, '#'));
    EXPECT_EQ(issue(file.path()).expected, "at most 16777216 bytes");
  }
}

TEST(Config, SurvivesHostileText) {
  const auto repeat = [](const std::string& part, int count) {
    std::string text;
    for (int i = 0; i < count; ++i) text += part;
    return text;
  };
  const int many = 200000;
  EXPECT_EQ(only_issue(minimal + "x = " + repeat("[", many)).where, "run.toml:3");
  EXPECT_EQ(only_issue(minimal + "x = " + repeat("{a=", many)).where, "run.toml:3");
  for (const std::string part : {"a.", "\"=\".", "'#' . ", "\"\\\"\"."})
    for (const std::string open : {"", "[", "[[", "x = {", "s = [\"\"\"a\"\"\"\", {"})
      EXPECT_EQ(only_issue(minimal + open + repeat(part, many) + "a = 1").expected,
                "at most 32 parts in a dotted key")
          << open << part;
  EXPECT_EQ(only_issue(minimal + repeat("x", many) + " = 1").key.size(), 90u);
  EXPECT_LT(only_issue(minimal + "levels = \"" + repeat("\xC3\xA9", many) + "\"").found.size(), 90u);
  EXPECT_EQ(only_issue(minimal + "levels = " + repeat("1", many)).where, "run.toml:3");
  EXPECT_EQ(only_issue(minimal + repeat("\xF0\x9F", many)).where, "run.toml:3");
  Input comment;
  EXPECT_TRUE(comment.parse(minimal + "#" + repeat(" a.b 'c \"\"\"", many)).empty()) << comment.what;
  Input list;
  EXPECT_TRUE(list.parse(minimal + "[output]\ntimes = [" + repeat("1.5,", many) + "]\ndir = \"" +
                         repeat("a.", many) + "\"")
                  .empty())
      << list.what;
  EXPECT_EQ(list.config.times.size(), static_cast<std::size_t>(many));
  for (const std::string tail : {"\"", "'", "\"\"\"", "'''", "\"\\", "\"\"\"\"", "a.", "[", "#", "\\", "."})
    EXPECT_EQ(only_issue(minimal + "x = " + tail).expected, "valid TOML") << tail;
}

// ---- programming errors ----

TEST(Config, BadDeclarationsAreLogicErrors) {
  double x = 5.0;
  Scheme scheme = static_cast<Scheme>(7);
  Schema schema;
  Table& table = schema.table("t", "");
  table.real("x", x);
  EXPECT_THROW(table.real("x", x), std::logic_error);
  EXPECT_THROW(table.real("a.b", x), std::logic_error);
  EXPECT_THROW(schema.table("t", ""), std::logic_error);
  EXPECT_THROW(schema.table("a b", ""), std::logic_error);
  Schema range;
  range.table("t", "").real("x", x).below(5);
  EXPECT_THROW(range.parse_text("", "a"), std::logic_error);
  Schema choice;
  choice.table("t", "").choice("scheme", scheme, {{"rk2", Scheme::rk2}});
  EXPECT_THROW(choice.parse_text("", "a"), std::logic_error);
  Schema required;  // the value of a required key is no default
  required.table("t", "").real("x", x).below(5).required();
  EXPECT_NO_THROW(required.parse_text("", "a"));
}

// ---- listings and the resolved input ----

TEST(Config, KeysText) {
  Input input;
  const std::string text = input.schema.keys_text();
  EXPECT_NE(text.find("[domain] (required) Size and resolution.\n"), std::string::npos) << text;
  EXPECT_NE(text.find("[[seed]] (list) Initial nuclei.\n"), std::string::npos) << text;
  for (const std::string word :
       {"width_um", "required", "> 0", "(0, 1)", "euler, rk2, rk4", "\"rk2\"", "3 integers", "list of texts",
        "[0.5, 1.0]", "unset", "K/um", "Pulling speed."})
    EXPECT_NE(text.find(word), std::string::npos) << word << "\n" << text;
  std::size_t column = text.find("meaning");
  for (const std::string doc : {"Width of the box.", "Folder.", "Shape."}) {
    const std::size_t at = text.find(doc);
    EXPECT_EQ(at - text.rfind('\n', at) - 1, column) << text;
  }
  ASSERT_TRUE(input.parse(minimal + "levels = 7").empty());
  EXPECT_EQ(input.schema.keys_text(), text);  // defaults, not the values read
}

TEST(Config, KeysMarkdown) {
  Input input;
  const std::string text = input.schema.keys_markdown();
  EXPECT_NE(text.find("\n## [domain] (required)\n\nSize and resolution.\n"), std::string::npos) << text;
  EXPECT_NE(text.find("| `width_um` | real | um | required | > 0 | Width of the box. |\n"),
            std::string::npos);
  EXPECT_NE(text.find("| `label` | text |  | unset |  | Label \\| tag. |\n"), std::string::npos) << text;
}

TEST(Config, ResolvedTextIsStable) {
  Input input;
  ASSERT_TRUE(input.parse("[domain]\nwidth_um = 3\n[[seed]]\nradius_um = 0.1\n").empty());
  EXPECT_EQ(input.schema.resolved_toml(), R"([domain]
width_um = 3.0
levels = 3
origin = [0.0, 0.0]
cells = [8, 8, 8]

[time]
courant = 0.5
scheme = "rk2"
steps = 1000

[output]
dir = "out"
restart = false
times = [0.5, 1.0]
ranks = []
fields = ["phi"]

[[seed]]
radius_um = 0.1
shape = "sphere"
)");
}

TEST(Config, ResolvedInputRoundTrips) {
  Input first;
  ASSERT_TRUE(first
                  .parse(R"([domain]
width_um = 0.1
origin = [-0.0, 1e22]
axis = [5e-324, 1.7976931348623157e308, 0.30000000000000004]
block = [2147483647, -2147483648]
[time]
steps = 9223372036854775807
scheme = "euler"
[output]
dir = "quote \" back \\ tab \t line \n bell \u0007 del \u007F é 🙂"
times = []
fields = ["", "#", "[x]"]
[thermal]
gradient = 1e-7
tilt = inf
[[seed]]
radius_um = 3.3333333333333335
position_um = [1, 2, 3]
[[seed]]
radius_um = 1e-10
)",
                         {"output.label=from the shell"})
                  .empty())
      << first.what;
  const std::string text = first.schema.resolved_toml();
  Input second;
  ASSERT_TRUE(second.parse(text).empty()) << second.what << text;
  EXPECT_EQ(second.schema.resolved_toml(), text);
  const Config &a = first.config, &b = second.config;
  EXPECT_EQ(a.width_um, b.width_um);
  EXPECT_EQ(a.origin, b.origin);
  EXPECT_TRUE(std::signbit(b.origin[0]));
  EXPECT_EQ(a.axis, b.axis);
  EXPECT_EQ(a.block, b.block);
  EXPECT_EQ(a.steps, b.steps);
  EXPECT_EQ(a.scheme, b.scheme);
  EXPECT_EQ(a.dir, b.dir);
  EXPECT_EQ(a.label, b.label);
  EXPECT_EQ(b.times.size(), 0u);
  EXPECT_EQ(a.fields, b.fields);
  EXPECT_EQ(a.gradient, b.gradient);
  EXPECT_EQ(a.tilt, b.tilt);
  EXPECT_FALSE(b.pull);
  ASSERT_EQ(b.seeds.size(), 2u);
  EXPECT_EQ(a.seeds[0].radius_um, b.seeds[0].radius_um);
  EXPECT_EQ(a.seeds[0].position_um, b.seeds[0].position_um);
  EXPECT_EQ(a.seeds[1].radius_um, b.seeds[1].radius_um);
  EXPECT_FALSE(b.seeds[1].position_um);
}

TEST(Config, RoundTripOfAwkwardNumbers) {
  double x = 0.0;
  Schema schema;
  schema.table("t", "", Schema::Presence::required).real("x", x);
  std::uint64_t state = 12345;
  for (int i = 0; i < 500; ++i) {
    state = state * 6364136223846793005u + 1442695040888963407u;
    const double value = std::ldexp(static_cast<double>(state >> 11), static_cast<int>(state % 1900) - 1000);
    x = value;
    Schema source;
    source.table("t", "", Schema::Presence::required).real("x", x);
    const std::string text = source.resolved_toml();
    x = 0.0;
    schema.parse_text(text, "again");
    ASSERT_EQ(x, value) << text;
  }
}

}  // namespace
}  // namespace dendrift::io

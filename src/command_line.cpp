#include "command_line.hpp"

#include <fmt/format.h>

#include <CLI/CLI.hpp>

#include "io/manifest.hpp"

namespace dendrift {

CommandLine parse_command_line(int argc, char** argv, bool print) {
  CommandLine c;
  std::vector<std::string> words;
  bool version = false;
  CLI::App app("Alloy dendrites on a tree of blocks. See docs/ for the model and the input.", "dendrift");
  app.add_option("input", words, "INPUT.toml, then any number of section.key=value");
  app.add_flag("--check", c.check, "validate the input, print derived numbers and an estimate of the cost, and stop");
  app.add_flag("--keys", c.keys, "list every key of the input: unit, default, range, meaning");
  app.add_flag("--markdown", c.markdown, "with --keys: as the page docs/keys.md");
  const CLI::Option* restart = app.add_option("--restart", c.restart, "checkpoint, or a folder whose newest sound one is taken, to continue from");
  app.add_flag("--allow-changes", c.allow_changes, "with --restart: even if the input has other physics than the checkpoint");
  app.add_flag("--version", version, "version, commit, compiler and flags");
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    if (print) {
      app.exit(e);
    }
    c.exit_code = e.get_exit_code() == 0 ? 0 : 2;
    return c;
  }
  if (version) {
    if (print) fmt::print("{}", io::version_text());
    c.exit_code = 0;
    return c;
  }
  if (c.keys) return c;
  if (restart->count() > 0 && c.restart.empty()) {
    if (print) fmt::print(stderr, "dendrift: --restart: expected a checkpoint or a folder of checkpoints, found nothing\n");
    c.exit_code = 2;
    return c;
  }
  if (words.empty()) {
    if (print) fmt::print(stderr, "dendrift: no input file; usage: dendrift INPUT.toml [section.key=value ...]\n");
    c.exit_code = 2;
    return c;
  }
  c.input = words.front();
  c.overrides.assign(words.begin() + 1, words.end());
  return c;
}

}  // namespace dendrift

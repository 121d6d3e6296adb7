/// \file
/// `dendrift`: runs dendrift2d or dendrift3d beside it, as mesh.dim of the input (or an override) says. Anything it
/// cannot read is left to the program itself, whose messages are better.

#include <unistd.h>

#include <cstdio>
#include <filesystem>
#include <string>
#include <toml++/toml.h>
#include <vector>

int main(int argc, char** argv) {
  std::int64_t dim = 2;
  std::string input;
  for (int i = 1; i < argc; ++i) {
    const std::string word = argv[i];
    if (word == "--restart") ++i;
    else if (input.empty() && word.find('=') == std::string::npos && !word.starts_with("-")) input = word;
  }
  try {
    if (!input.empty() && std::filesystem::is_regular_file(input))
      dim = toml::parse_file(input)["mesh"]["dim"].value_or(std::int64_t{2});
  } catch (const toml::parse_error&) {
    dim = 2;
  }
  for (int i = 1; i < argc; ++i) {
    const std::string word = argv[i];
    if (word == "mesh.dim=3") dim = 3;
    if (word == "mesh.dim=2") dim = 2;
  }
  std::error_code error;
  const std::filesystem::path self = std::filesystem::read_symlink("/proc/self/exe", error);
  const std::string program = (self.parent_path() / (dim == 3 ? "dendrift3d" : "dendrift2d")).string();
  execv(program.c_str(), argv);
  std::perror(("dendrift: could not start " + program).c_str());
  return 4;
}

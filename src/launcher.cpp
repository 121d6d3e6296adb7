/// \file
/// `dendrift`: runs dendrift2d or dendrift3d beside it, as mesh.dim of the input (or an override) says. It only glances at
/// the input, line by line, so that no input can upset it; what is wrong with one is for the program itself to say.

#include <unistd.h>

#include <cstdio>
#include <filesystem>
#include <fstream>
#include <string>

namespace {

std::string without_spaces(const std::string& line) {
  std::string s;
  for (const char c : line) {
    if (c == '#') break;
    if (c != ' ' && c != '\t' && c != '\r') s += c;
  }
  return s;
}

/// 3 if the input says so, 2 otherwise.
int dimension_of(const std::string& input) {
  std::error_code error;
  if (!std::filesystem::is_regular_file(input, error)) return 2;
  std::ifstream in(input);
  std::string line, table;
  while (std::getline(in, line)) {
    const std::string s = without_spaces(line);
    if (s.starts_with("[")) table = s;
    if ((table == "[mesh]" && s == "dim=3") || (table.empty() && s == "mesh.dim=3")) return 3;
  }
  return 2;
}

}  // namespace

int main(int argc, char** argv) {
  std::string input;
  int dim = 0;
  for (int i = 1; i < argc; ++i) {
    const std::string word = argv[i];
    if (word == "mesh.dim=2" || word == "mesh.dim=3") dim = word.back() - '0';
    if (word == "--restart") {
      ++i;
    } else if (input.empty() && word.find('=') == std::string::npos && !word.starts_with("-")) {
      input = word;
    }
  }
  if (dim == 0) dim = input.empty() ? 2 : dimension_of(input);
  std::error_code error;
  const std::filesystem::path self = std::filesystem::read_symlink("/proc/self/exe", error);
  const std::string program = (self.parent_path() / (dim == 3 ? "dendrift3d" : "dendrift2d")).string();
  execv(program.c_str(), argv);
  std::perror(("dendrift: could not start " + program).c_str());
  return 4;
}

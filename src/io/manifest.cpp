#include "io/manifest.hpp"

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <omp.h>
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <cstring>
#include <fstream>

#include "amr/dim.hpp"
#include "build_info.hpp"
#include "io/hdf5.hpp"

namespace dendrift::io {

namespace {

std::string quoted(std::string_view text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') {
      out += '\\';
      out += c;
    } else if (c == '\n') {
      out += "\\n";
    } else if (static_cast<unsigned char>(c) < 0x20) {
      out += fmt::format("\\u{:04x}", c);
    } else {
      out += c;
    }
  }
  return out + "\"";
}

std::string cpu_model() {
  std::ifstream in("/proc/cpuinfo");
  for (std::string line; std::getline(in, line);)
    if (line.starts_with("model name")) return line.substr(line.find(':') + 2);
  return "unknown";
}

}  // namespace

std::string time_stamp() {
  return fmt::format("{:%Y-%m-%dT%H:%M:%SZ}", fmt::gmtime(std::chrono::system_clock::to_time_t(std::chrono::system_clock::now())));
}

std::string version_text() {
  return fmt::format("dendrift {} ({}D), commit {}\n{}, {}: {}\n", build_info::version, DIM, build_info::git_hash,
                     build_info::compiler, build_info::build_type, build_info::flags);
}

void write_manifest(const std::string& path, const Manifest& m) {
  char host[256] = {};
  gethostname(host, sizeof host - 1);
  std::string phases;
  for (const auto& [name, seconds] : m.phases)
    phases += fmt::format("{}\n    {}: {{\"seconds\": {:.4f}, \"share\": {:.4f}}}", phases.empty() ? "" : ",",
                          quoted(name), seconds, m.wall_s > 0 ? seconds / m.wall_s : 0);
  const std::string text = fmt::format(
      "{{\n  \"program\": \"dendrift{}d\",\n  \"version\": {},\n  \"git_hash\": {},\n  \"compiler\": {},\n"
      "  \"build_type\": {},\n  \"flags\": {},\n  \"machine\": {{\"host\": {}, \"cpu\": {}}},\n  \"ranks\": {},\n"
      "  \"threads\": {},\n  \"start\": {},\n  \"end\": {},\n  \"status\": {},\n  \"exit_code\": {},\n"
      "  \"message\": {},\n  \"steps\": {},\n"
      "  \"time_s\": {},\n  \"blocks\": {},\n  \"block_cells\": {},\n  \"wall_s\": {:.3f},\n"
      "  \"wall_by_phase\": {{{}\n  }},\n  \"input\": {}\n}}\n",
      DIM, quoted(build_info::version), quoted(build_info::git_hash), quoted(build_info::compiler),
      quoted(build_info::build_type), quoted(build_info::flags), quoted(host), quoted(cpu_model()), m.ranks,
      omp_get_max_threads(), quoted(m.started), quoted(m.status == "running" ? "" : time_stamp()), quoted(m.status),
      m.exit_code ? std::to_string(*m.exit_code) : "null", quoted(m.message), m.steps,
      m.time_s, m.blocks, m.block_cells, m.wall_s, phases, quoted(m.input));
  const std::string part = path + ".part";
  std::FILE* f = std::fopen(part.c_str(), "w");
  if (f == nullptr) throw OutputError(part, "create the file", std::strerror(errno));
  const bool written = std::fwrite(text.data(), 1, text.size(), f) == text.size();
  if (std::fclose(f) != 0 || !written) {
    const std::string reason = std::strerror(errno);
    remove_quietly(part);
    throw OutputError(part, "write the file", reason);
  }
  complete_file(part, path);
}

}  // namespace dendrift::io

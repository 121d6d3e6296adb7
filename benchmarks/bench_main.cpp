// dendrift-bench [NAME ...] [--table] [--benchmark_...]: in-process benchmarks, JSON on stdout. NAME selects the
// benchmarks whose names contain it; none selects all.
#include <fmt/format.h>
#include <mpi.h>
#include <omp.h>

#include <cstdlib>
#include <fstream>
#include <string>
#include <string_view>

#include "build_info.hpp"
#include "common.hpp"

namespace {

using namespace dendrift;

std::string processor() {
  std::ifstream in("/proc/cpuinfo");
  for (std::string line; std::getline(in, line);)
    if (line.starts_with("model name")) return line.substr(line.find(':') + 2);
  return "unknown";
}

// A regular expression that matches names containing `name`.
std::string escaped(std::string_view name) {
  std::string s;
  for (const char c : name) {
    if (std::string_view(".^$|()[]{}*+?\\").find(c) != std::string_view::npos) s += '\\';
    s += c;
  }
  return s;
}

int run(int argc, char** argv) {
  std::vector<std::string> flags{argv[0], "--benchmark_repetitions=5", "--benchmark_format=json"};
  std::string filter;
  for (int i = 1; i < argc; ++i) {
    const std::string_view arg = argv[i];
    if (arg == "--table") {
      flags.emplace_back("--benchmark_format=console");
    } else if (arg.starts_with("--")) {
      flags.emplace_back(arg);  // google/benchmark's own; the last one of a kind counts
    } else {
      filter += (filter.empty() ? "" : "|") + escaped(arg);
    }
  }
  if (!filter.empty()) flags.push_back("--benchmark_filter=" + filter);
  std::vector<char*> pointers;
  for (std::string& f : flags) pointers.push_back(f.data());
  int count = static_cast<int>(pointers.size());
  benchmark::Initialize(&count, pointers.data());
  if (benchmark::ReportUnrecognizedArguments(count, pointers.data())) return 2;

  // A comparison of two programs that compute different things would mean nothing.
  for (const int n : {8, 16, 32}) {
    const double difference = bench::kernel_minus_plain(n);
    if (!(difference < 1e-12)) {
      fmt::print(stderr, "dendrift-bench: kernel (blocks of {}) and plain loop differ by {:.3g}; expected less than 1e-12\n",
                 n, difference);
      return 1;
    }
  }
  if (std::getenv("OMP_NUM_THREADS") == nullptr) omp_set_num_threads(1);
  benchmark::AddCustomContext("dimensions", std::to_string(DIM));
  benchmark::AddCustomContext("processor", processor());
  benchmark::AddCustomContext("threads", std::to_string(omp_get_max_threads()));
  benchmark::AddCustomContext("compiler", std::string(build_info::compiler));
  benchmark::AddCustomContext("flags", std::string(build_info::flags));
  benchmark::AddCustomContext("commit", std::string(build_info::git_hash));
  return benchmark::RunSpecifiedBenchmarks() == 0 ? 2 : 0;
}

}  // namespace

int main(int argc, char** argv) {
  int provided = 0;
  MPI_Init_thread(&argc, &argv, MPI_THREAD_FUNNELED, &provided);
  int code = 0;
  try {
    code = run(argc, argv);
  } catch (const std::exception& e) {
    fmt::print(stderr, "dendrift-bench: {}\n", e.what());
    code = 1;
  }
  MPI_Finalize();
  return code;
}

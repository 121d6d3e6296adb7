/// \file
/// The same targets for clang's libFuzzer, which looks for new ways through the code by itself. With DENDRIFT_FUZZ_CHECKPOINT:
/// checkpoints, else inputs.
#include <fcntl.h>
#include <mpi.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <string>

#include "targets.hpp"

namespace {

using namespace dendrift::fuzz;

#ifdef DENDRIFT_FUZZ_CHECKPOINT

std::string folder;

Checkpoints& checkpoints() {
  static Checkpoints* const all = [] {
    int provided = 0;
    MPI_Init_thread(nullptr, nullptr, MPI_THREAD_FUNNELED, &provided);
    folder = (std::filesystem::temp_directory_path() / "dendrift_fuzz_XXXXXX").string();
    if (mkdtemp(folder.data()) == nullptr) std::abort();
    std::atexit([] { std::filesystem::remove_all(folder); });
    return new Checkpoints(folder);
  }();
  return *all;
}

#endif

}  // namespace

extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t max_size);

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const std::string bytes(reinterpret_cast<const char*>(data), size);
#ifdef DENDRIFT_FUZZ_CHECKPOINT
  static_cast<void>(checkpoints().attempt(bytes, true));
#else
  static_cast<void>(try_input(bytes));
#endif
  return 0;
}

// Half of the changes are those of our own, which know lines, numbers and datasets.
extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size, unsigned seed) {
  Chance chance(seed, 0);
  if (chance.one_in(2)) return LLVMFuzzerMutate(data, size, max_size);
  const std::string before(reinterpret_cast<const char*>(data), size);
#ifdef DENDRIFT_FUZZ_CHECKPOINT
  const std::string after = checkpoints().mutant(before.size() < 1000 ? checkpoints().good() : before, true, chance);
#else
  const std::string after = mutate_input(before, {before}, chance);
#endif
  std::memcpy(data, after.data(), std::min(after.size(), max_size));
  return std::min(after.size(), max_size);
}

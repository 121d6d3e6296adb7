/// \file
/// Spoils inputs, or checkpoints, and counts what comes of it. Each mutant is made from the seed and its number alone. A child
/// tries them one after the other; when it crashes or hangs, the parent keeps the mutant and starts another child behind it.
///
///     dendrift_fuzz2d inputs FOLDER [mutants=20000] [seed=1] [save=DIR] [limit_s=10]
///     dendrift_fuzz2d checkpoint    [mutants=5000]  [seed=1] [save=DIR] [limit_s=20] [what=content]
///                           what=content: HDF5's bookkeeping stays sound
///     dendrift_fuzz2d input FILE            one file, as a crash left it
///     dendrift_fuzz2d restart FILE          one checkpoint, sealed anew
///     dendrift_fuzz2d write inputs FOLDER [mutants=300] save=DIR      mutants as files, for the real program
///     dendrift_fuzz2d write checkpoint    [mutants=100] save=DIR
///
/// Exit status 1 if anything but acceptance and refusal was seen.
#include <fcntl.h>
#include <fmt/format.h>
#include <mpi.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <new>
#include <string>
#include <vector>

#include "amr/dim.hpp"
#include "targets.hpp"

namespace {

using namespace dendrift;
using namespace dendrift::fuzz;
namespace fs = std::filesystem;

struct Options {
  std::string mode, what;
  std::size_t mutants = 0, seed = 1, limit_s = 0;
  std::string save = ".";
  bool content = false;
};

/// What the mutants are made from, and what is done with them.
class Job {
 public:
  virtual ~Job() = default;
  virtual std::string mutant(std::size_t number) = 0;
  virtual Verdict attempt(const std::string& mutant) = 0;
  virtual const char* suffix() const = 0;
};

class Inputs : public Job {
 public:
  Inputs(const std::string& folder, std::size_t seed) : seed_(seed) {
    const std::string mine = "dim = " + std::to_string(DIM);
    std::map<std::string, std::string> sorted;  // directories are in no order
    if (!folder.empty())
      for (const auto& entry : fs::recursive_directory_iterator(folder))
        if (entry.path().extension() == ".toml") sorted[entry.path().string()] = content_of(entry.path().string());
    for (const auto& [path, text] : sorted) {
      all_.push_back(text);
      if (text.find(mine) != std::string::npos) texts_.push_back(text);
    }
  }
  std::size_t files() const { return texts_.size(); }
  std::string mutant(std::size_t number) override {
    Chance chance(seed_, number);
    return mutate_input(texts_[number % texts_.size()], all_, chance);
  }
  Verdict attempt(const std::string& mutant) override { return try_input(mutant); }
  const char* suffix() const override { return ".toml"; }

 private:
  std::size_t seed_;
  std::vector<std::string> texts_, all_;  // of this dimension; of both, to lend lines
};

class Restarts : public Job {
 public:
  Restarts(const std::string& folder, const Options& o) : seed_(o.seed), with_bookkeeping_(!o.content), folder_(folder) {}
  ~Restarts() override {
    checkpoints_.reset();
    if (started_) MPI_Finalize();
  }
  std::string mutant(std::size_t number) override {
    Chance chance(seed_, number);
    return checkpoints().mutant(checkpoints().good(), with_bookkeeping_, chance);
  }
  Verdict attempt(const std::string& mutant) override { return checkpoints().attempt(mutant, ++tried_ % 16 != 0); }
  const char* suffix() const override { return ".h5"; }

 private:
  // Late, because MPI does not survive a fork.
  Checkpoints& checkpoints() {
    if (!checkpoints_) {
      int provided = 0;
      MPI_Init_thread(nullptr, nullptr, MPI_THREAD_FUNNELED, &provided);
      started_ = true;
      checkpoints_ = std::make_unique<Checkpoints>(folder_);
    }
    return *checkpoints_;
  }
  std::size_t seed_, tried_ = 0;
  bool with_bookkeeping_;
  std::string folder_;
  bool started_ = false;
  std::unique_ptr<Checkpoints> checkpoints_;
};

/// What child and parent share.
struct Board {
  static constexpr std::size_t CAUSES = 64, LENGTH = 80;
  struct Cause {
    std::array<char, LENGTH> name;
    std::size_t count;
  };
  std::size_t number, accepted, wrong;
  std::array<Cause, CAUSES> causes;

  void refuse(const std::string& cause) {
    std::size_t i = 0;
    while (i + 1 < CAUSES && causes[i].count > 0 && cause.substr(0, LENGTH - 1) != causes[i].name.data()) ++i;
    const std::string name = i + 1 < CAUSES ? cause.substr(0, LENGTH - 1) : "others";
    std::memcpy(causes[i].name.data(), name.c_str(), name.size() + 1);
    ++causes[i].count;
  }
};

Board* shared_board() {
  void* memory = mmap(nullptr, sizeof(Board), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  return memory == MAP_FAILED ? nullptr : new (memory) Board{};
}

void keep(const Options& o, const std::string& mutant, const char* suffix, std::size_t number) {
  const fs::path path = fs::path(o.save) / fmt::format("mutant_{}d_{}_{}{}", DIM, o.seed, number, suffix);
  std::ofstream(path, std::ios::binary) << mutant;
  fmt::print(stderr, "kept in {}\n", path.string());
}

// In the child: all mutants from board.number on.
void work(Job& job, const Options& o, Board& board) {
  dup2(open("/dev/null", O_WRONLY), STDOUT_FILENO);  // a restart that is accepted says so
  for (; board.number < o.mutants; ++board.number) {
    alarm(static_cast<unsigned>(o.limit_s));
    const std::string mutant = job.mutant(board.number);
    if (std::strcmp(job.suffix(), ".h5") == 0) std::ofstream(fs::path(o.save) / "last.h5", std::ios::binary) << mutant;
    try {
      const Verdict verdict = job.attempt(mutant);
      verdict.accepted ? void(++board.accepted) : board.refuse(verdict.cause);
    } catch (const std::exception& e) {
      ++board.wrong;
      fmt::print(stderr, "mutant {}: {}\n", board.number, e.what());
      keep(o, mutant, job.suffix(), board.number);
    }
  }
  alarm(0);
}

int try_all(const std::string& title, const Options& o, const auto& make_job) {
  const auto begin = std::chrono::steady_clock::now();
  Board& board = *shared_board();
  std::size_t crashes = 0, hangs = 0;
  while (board.number < o.mutants) {
    const pid_t child = fork();
    if (child == 0) {
      const auto job = make_job();
      work(*job, o, board);
      std::_Exit(0);
    }
    int status = 0;
    waitpid(child, &status, 0);
    if (board.number >= o.mutants) break;
    const bool hang = WIFSIGNALED(status) && WTERMSIG(status) == SIGALRM;
    ++(hang ? hangs : crashes);
    fmt::print(stderr, "mutant {}: {}, status {:#x}\n", board.number, hang ? "a hang" : "a crash", status);
    const auto job = make_job();
    const bool checkpoint = std::strcmp(job->suffix(), ".h5") == 0;
    keep(o, checkpoint ? content_of((fs::path(o.save) / "last.h5").string()) : job->mutant(board.number), job->suffix(), board.number);
    if (crashes + hangs > 200) {
      fmt::print(stderr, "that is enough\n");
      break;
    }
    ++board.number;
  }
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  fmt::print("{}, {}D, seed {}: {} mutants in {:.1f} s\n{:>8} accepted\n", title, DIM, o.seed, board.number, seconds, board.accepted);
  for (const Board::Cause& c : board.causes)
    if (c.count > 0) fmt::print("{:>8} refused: {}\n", c.count, c.name.data());
  fmt::print("{:>8} crashes\n{:>8} hangs\n{:>8} wrong\n", crashes, hangs, board.wrong);
  return crashes + hangs + board.wrong == 0 ? 0 : 1;
}

int write_mutants(Job& job, const Options& o) {
  for (std::size_t i = 0; i < o.mutants; ++i)
    std::ofstream(fs::path(o.save) / fmt::format("{:05d}{}", i, job.suffix()), std::ios::binary) << job.mutant(i);
  return 0;
}

int one(Job& job, const std::string& file) {
  const Verdict verdict = job.attempt(content_of(file));
  fmt::print("{}\n", verdict.accepted ? "accepted" : "refused: " + verdict.cause);
  return 0;
}

Options parse(const std::vector<std::string>& words) {
  Options o;
  const std::map<std::string, std::size_t*> numbers{{"mutants", &o.mutants}, {"seed", &o.seed}, {"limit_s", &o.limit_s}};
  for (const std::string& word : words) {
    const auto equals = word.find('=');
    const std::string name = word.substr(0, equals);
    if (equals != std::string::npos && numbers.contains(name)) {
      *numbers.at(name) = std::stoul(word.substr(equals + 1));
    } else if (word == "what=content") {
      o.content = true;
    } else if (equals != std::string::npos && name == "save") {
      o.save = word.substr(equals + 1);
    } else {
      (o.mode.empty() ? o.mode : o.what) += (o.mode == "write" && !o.what.empty() ? " " : "") + word;
    }
  }
  return o;
}

}  // namespace

int main(int argc, char** argv) {
  Options o = parse({argv + 1, argv + argc});
  fs::create_directories(o.save);
  const bool writes = o.mode == "write", inputs = o.mode == "inputs" || (writes && o.what.starts_with("inputs "));
  if (inputs || o.mode == "input") {
    if (o.mutants == 0) o.mutants = writes ? 300 : 20000;
    if (o.limit_s == 0) o.limit_s = 10;
    Inputs job(!inputs ? "" : writes ? o.what.substr(7) : o.what, o.seed);
    if (!inputs) return one(job, o.what);
    if (job.files() == 0) return fmt::print(stderr, "no inputs in {}\n", o.what), 2;
    if (writes) return write_mutants(job, o);
    return try_all(fmt::format("{} inputs", job.files()), o, [&] { return std::make_unique<Inputs>(job); });
  }
  if (o.mode == "checkpoint" || o.mode == "restart" || (writes && o.what == "checkpoint")) {
    if (o.mutants == 0) o.mutants = writes ? 100 : 5000;
    if (o.limit_s == 0) o.limit_s = 20;
    std::string folder = (fs::temp_directory_path() / "dendrift_fuzz_XXXXXX").string();
    if (mkdtemp(folder.data()) == nullptr) return 2;
    int status = 0;
    {
      Restarts job(folder, o);
      if (o.mode == "restart") status = one(job, o.what);
      if (writes) status = write_mutants(job, o);
    }
    if (o.mode == "checkpoint") status = try_all("checkpoints", o, [&] { return std::make_unique<Restarts>(folder, o); });
    fs::remove_all(folder);
    return status;
  }
  fmt::print(stderr, "usage: {} inputs FOLDER | checkpoint | input FILE | restart FILE | write ...; see the head of its source\n", argv[0]);
  return 2;
}

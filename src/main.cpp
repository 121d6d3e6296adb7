/// \file
/// The program: read, check, run. DIM is fixed at build time; the launcher `dendrift` picks the right program.

#include <fmt/format.h>
#include <mpi.h>

#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <memory>

#include "command_line.hpp"
#include "io/hdf5.hpp"
#include "io/manifest.hpp"
#include "restart.hpp"
#include "settings.hpp"
#include "simulation.hpp"

namespace {

using namespace dendrift;

void on_signal(int number) {
  static volatile std::sig_atomic_t interrupted = 0;
  if (number == SIGINT && interrupted != 0) {  // who asks twice does not want to wait for a checkpoint
    std::signal(SIGINT, SIG_DFL);
    std::raise(SIGINT);
  }
  if (number == SIGINT) interrupted = 1;
  Simulation::request_stop();
}

int run(const CommandLine& command, bool root) {
  // 1. What is asked for
  Settings settings;
  if (command.keys) {
    if (root) fmt::print("{}", command.markdown ? settings.schema.keys_markdown() : settings.schema.keys_text());
    return 0;
  }
  settings.parse(command.input, command.overrides);

  // 2. The state: a fresh one, or that of a checkpoint
  const std::unique_ptr<Simulation> simulation =
      command.restart.empty() ? std::make_unique<Simulation>(settings, MPI_COMM_WORLD)
                              : restart(settings, MPI_COMM_WORLD, command.restart, command.allow_changes);
  if (command.check) {
    simulation->print_check();
    return 0;
  }

  // 3. The run
  for (const int s : {SIGTERM, SIGINT, SIGUSR1}) std::signal(s, on_signal);
  return simulation->run() == Outcome::stopped ? exit_code::stopped : exit_code::done;
}

}  // namespace

int main(int argc, char** argv) {
  int provided = 0, rank = 0;
  MPI_Init_thread(&argc, &argv, MPI_THREAD_FUNNELED, &provided);
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  int code = 0;
  const auto fail = [&](int status, const std::string& message) {
    if (rank == 0 || status == 1) fmt::print(stderr, "dendrift: {}\n", message);
    code = status;
  };
  try {
    const CommandLine command = parse_command_line(argc, argv, rank == 0);
    code = command.exit_code ? *command.exit_code : run(command, rank == 0);
  } catch (const io::InputError& e) {
    fail(exit_code::bad_input, e.what());
  } catch (const NumericalError& e) {
    fail(exit_code::numerical_failure, e.what());
  } catch (const io::OutputError& e) {
    fail(exit_code::output_failure, e.what());
  } catch (const std::exception& e) {
    fail(1, fmt::format("rank {}: {}", rank, e.what()));
    MPI_Abort(MPI_COMM_WORLD, 1);  // one rank alone: the others would wait forever
  }
  if (code == exit_code::output_failure) {
    MPI_Barrier(MPI_COMM_WORLD);  // the message is out before a launcher ends the others
    std::fflush(nullptr);
    if (io::hdf5_is_broken()) std::_Exit(code);
  }
  MPI_Finalize();
  return code;
}

/// \file
/// --restart: which checkpoint, and whether it goes with the input.
#pragma once

#include <mpi.h>

#include <memory>
#include <string>
#include <vector>

#include "io/checkpoint.hpp"
#include "settings.hpp"

namespace dendrift {

class Simulation;

/// Continues from a checkpoint, or from the newest one of a folder that is sound; says on standard error which were passed
/// over and why. Throws io::OutputError if none is sound, io::InputError if the first sound one does not go with the input.
/// Collective.
std::unique_ptr<Simulation> restart(Settings& settings, MPI_Comm comm, const std::string& file_or_dir, bool allow_changes);

/// Numbers derived from the input that give the state of a checkpoint its meaning.
std::vector<double> shape_numbers(const Settings& settings);

/// Throws io::InputError if the input has other physics or another mesh than the checkpoint, each key with both values. With
/// `allow_changes` only if the state would fit no longer.
void require_same_scene(const Settings& settings, const std::string& file, const io::RunState& state, bool allow_changes);

/// What the restart continues from and what it changes, for the log; `origin`: that of this run.
std::string restart_log(const Settings& settings, const std::string& file, const io::RunState& state, const std::string& origin);

}  // namespace dendrift

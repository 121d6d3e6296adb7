/// \file
/// Checkpoints: the complete state, independent of the number of ranks that wrote it.
#pragma once

#include <mpi.h>

#include <map>
#include <string>
#include <vector>

#include "amr/mesh.hpp"

namespace dendrift::io {

/// What a run needs besides the fields.
struct RunState {
  double time = 0;  ///< tau0
  std::int64_t step = 0;
  std::map<std::string, std::vector<double>> numbers;  ///< whatever else the program must remember, by name
  std::string input;                                   ///< the resolved input, TOML
};

inline constexpr int CHECKPOINT_FORMAT = 1;

/// Writes path + ".part", syncs, and renames. Collective; throws OutputError on every rank or none.
void write_checkpoint(const std::string& path, const amr::Mesh& mesh, const RunState& state);

/// Names of the chk_*.h5 of a folder, by number.
std::vector<std::string> list_checkpoints(const std::string& dir);

/// The newest chk_*.h5 of a folder, or the file itself. Throws OutputError if there is none.
std::string find_checkpoint(const std::string& file_or_dir);

/// Number and input only. Collective.
RunState read_state(const std::string& path, MPI_Comm comm);

/// The leaves stored in a checkpoint. Collective.
std::vector<amr::BlockIndex> read_leaves(const std::string& path, MPI_Comm comm);

/// Reads the fields of this rank's blocks; the mesh must hold the leaves of the checkpoint. Collective.
void read_fields(const std::string& path, amr::Mesh& mesh);

}  // namespace dendrift::io

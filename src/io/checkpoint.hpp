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
  std::string origin;  ///< one line on the program, ranks and threads; does not count as state
  int dim = DIM;
  int format = 0;  ///< of the file that it was read from
};

/// Numbers of the fields that a checkpoint holds.
std::vector<int> checkpointed(const amr::FieldTable& fields);

/// 1: no checksums. 2: a seal (io/seal.hpp), and a checksum of every leaf of every field.
inline constexpr int CHECKPOINT_FORMAT = 2;

// All but the first function are collective, and throw OutputError on every rank or none.

/// Names of the chk_*.h5 of a folder, by number. One rank calls it.
std::vector<std::string> list_checkpoints(const std::string& dir);

/// The file itself, or the chk_*.h5 of a folder, newest first. At least one.
std::vector<std::string> find_checkpoints(const std::string& file_or_dir, MPI_Comm comm);

/// Writes path + ".part", has it brought to the disk, and renames it. After a failure nothing of it is left.
void write_checkpoint(const std::string& path, const amr::Mesh& mesh, const RunState& state);

/// All but leaves and fields. Refuses files that are damaged beside the values of fields, or of a newer version.
RunState read_state(const std::string& path, MPI_Comm comm);

/// The leaves stored in a checkpoint.
std::vector<amr::BlockIndex> read_leaves(const std::string& path, MPI_Comm comm);

/// Fields that the mesh wants from a checkpoint and the file does not hold.
std::vector<std::string> missing_fields(const std::string& path, const amr::Mesh& mesh);

/// Reads the fields of this rank's blocks, and checks their checksums; the mesh must hold the leaves of the checkpoint.
void read_fields(const std::string& path, amr::Mesh& mesh);

}  // namespace dendrift::io

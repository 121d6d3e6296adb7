/// \file
/// Whether a mesh fits into the memory of the machine, asked before it is built: Linux grants memory that it does not
/// have and ends the program when it is used.
#pragma once

#include <mpi.h>

#include <cstdint>

#include "amr/field.hpp"
#include "amr/mesh.hpp"

namespace dendrift {

/// Bytes that a rank needs for its share of the blocks and for its copy of the tree; more while the mesh changes.
double bytes_of_rank(std::int64_t blocks, int ranks, int arrays, const amr::Layout& layout);

/// What a mesh of so many blocks takes on the fullest node, and what there is. Collective.
struct Memory {
  double needed = 0, present = 0;  ///< bytes
  bool enough() const { return needed <= present; }
};
Memory memory_of_mesh(std::int64_t blocks, const amr::FieldTable& fields, const amr::Layout& layout, MPI_Comm comm);

}  // namespace dendrift

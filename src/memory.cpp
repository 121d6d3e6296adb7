#include "memory.hpp"

#include <unistd.h>

#include <cmath>

#include "amr/comm.hpp"

namespace dendrift {

double bytes_of_rank(std::int64_t blocks, int ranks, int arrays, const amr::Layout& layout) {
  // The tree: index, key, owner, place, neighbours of every block.
  constexpr double TREE = sizeof(amr::BlockIndex) + sizeof(std::uint64_t) + 2 * sizeof(int) +
                          DIRECTIONS * sizeof(amr::Neighbour);
  const double own = std::ceil(static_cast<double>(blocks) / ranks);
  return static_cast<double>(blocks) * TREE +
         own * arrays * static_cast<double>(layout.size()) * static_cast<double>(sizeof(double));
}

Memory memory_of_mesh(std::int64_t blocks, const amr::FieldTable& fields, const amr::Layout& layout, MPI_Comm comm) {
  int ranks = 1, on_node = 1;
  MPI_Comm_size(comm, &ranks);
  MPI_Comm node = MPI_COMM_NULL;
  MPI_Comm_split_type(comm, MPI_COMM_TYPE_SHARED, 0, MPI_INFO_NULL, &node);
  MPI_Comm_size(node, &on_node);
  MPI_Comm_free(&node);
  Memory m;
  const double needed = on_node * bytes_of_rank(blocks, ranks, fields.size(), layout);
  const double present = static_cast<double>(sysconf(_SC_PHYS_PAGES)) * static_cast<double>(sysconf(_SC_PAGESIZE));
  // The node that has least for what it needs speaks for all, so that all ranks come to the same verdict.
  m.needed = amr::global_max(needed, comm);
  m.present = amr::global_min(present, comm);
  return m;
}

}  // namespace dendrift

/// \file
/// Filling ghost cells: copies between equal levels, means from finer blocks, third-order prolongation from
/// coarser ones, and the rules beyond the sides of the domain.
#pragma once

#include <mpi.h>

#include <vector>

#include "amr/mesh.hpp"
#include "amr/transfer.hpp"

namespace dendrift::amr {

/// The plan of who needs what for one mesh, and the messages that carry it. One message a neighbouring rank,
/// whatever the number of fields. The plan is rebuilt by itself when the mesh has changed.
///
/// A block whose neighbour is coarser keeps a small copy of its surroundings at the coarser spacing, filled by
/// the same single exchange, and prolongs from there: no second round of messages, and no dependence on order.
class GhostExchange {
 public:
  explicit GhostExchange(Mesh& mesh);
  ~GhostExchange();
  GhostExchange(const GhostExchange&) = delete;
  GhostExchange& operator=(const GhostExchange&) = delete;

  /// Fills the ghosts of `fields` in all blocks. Collective.
  void fill(std::vector<CellField> fields);

  /// Fills ghosts and runs kernel(b) on each block as soon as its ghosts are there: blocks that need nothing
  /// from other ranks go first, while the messages travel. kernel may change any array of block b except the
  /// interiors of `fields`, which other blocks still read. Blocks that are not `wanted` (by local number; null: all are)
  /// are passed over: their ghosts stay what they were. Collective.
  template <class Kernel>
  void fill_and_run(std::vector<CellField> fields, Kernel&& kernel, const std::vector<char>* wanted = nullptr) {
    start(std::move(fields));
    const auto run = [&](const std::vector<int>& blocks) {
      parallel_for(static_cast<int>(blocks.size()), [&](int i) {
        const int b = blocks[static_cast<std::size_t>(i)];
        if (wanted != nullptr && (*wanted)[static_cast<std::size_t>(b)] == 0) return;
        fill_block(b);
        kernel(b);
      });
    };
    run(inner_);
    wait();
    run(outer_);
  }

  double wait_seconds() const { return wait_seconds_; }  ///< waiting for messages so far
  double fill_seconds() const;                           ///< copying, restricting, prolonging; mean over threads

 private:
  struct Copy {                 // one box of one block's surroundings
    int slot = -1;              // source block of this rank, or -1
    std::ptrdiff_t packed = 0;  // otherwise: cells before it in the message
    int message = -1;           // ... from this neighbouring rank
    bool restricts = false;     // source is finer than the destination box
    bool to_coarse = false;     // destination is the coarse copy, not the block
    IntVec src_lo{}, dst_lo{}, size{};
  };
  struct Plan {
    int first = 0, last = 0;        // range of copies
    std::uint32_t coarser = 0;      // bit d: direction d is to be prolonged
    std::uint32_t outside = 0;      // bit f: face f is a side of the domain
    IntVec rim_lo{}, rim_size{};    // coarse cells of the block itself that prolongation reads
  };
  struct Message {
    int rank = 0;
    std::ptrdiff_t send_cells = 0, recv_cells = 0;
    std::vector<Copy> sends;  // slot is the source, packed the place in the message
    std::vector<double> send, recv;
  };
  struct Source;

  void rebuild();
  void copies_of(int leaf, std::vector<Source>& out) const;
  void start(std::vector<CellField> fields);
  void wait();
  void fill_block(int b);
  void fill_coarse_and_prolong(const Plan& plan, CellField field, int b, double* coarse) const;
  void apply_sides(std::uint32_t outside, const FieldSpec& spec, ArrayRef<double> a, int cells, int ghosts) const;
  ArrayRef<double> coarse_ref(double* p) const;
  std::ptrdiff_t coarse_size() const;
  void run_copy(const Copy& c, CellField f, std::size_t field, ArrayRef<double> dst) const;

  Mesh& mesh_;
  std::int64_t generation_ = -1;
  std::vector<CellField> fields_;
  std::vector<Copy> copies_;
  std::vector<Plan> plans_;
  std::vector<int> inner_, outer_;
  std::vector<Message> messages_;
  std::vector<MPI_Request> requests_;
  double wait_seconds_ = 0;
  struct alignas(64) Clock {
    double seconds = 0;
  };
  std::vector<Clock> clocks_;  // one a thread
};

}  // namespace dendrift::amr

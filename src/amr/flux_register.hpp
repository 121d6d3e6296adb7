/// \file
/// Fluxes through faces where a block meets finer ones, so that what leaves one side enters the other.
#pragma once

#include <mpi.h>

#include <vector>

#include "amr/loops.hpp"
#include "amr/mesh.hpp"

namespace dendrift::amr {

/// One register serves one conserved field. A kernel leaves its fluxes at store(b, face) wherever that is not
/// null; reflux() then hands each coarse block the difference it must apply. Face values are packed, n^(DIM-1)
/// of them, the lower tangential axis fastest; fluxes count along the positive axis.
class FluxRegister {
 public:
  explicit FluxRegister(Mesh& mesh) : mesh_(mesh) {}

  /// Adjusts to the mesh; call before the kernels run. Purely local.
  void prepare() {
    if (generation_ != mesh_.generation()) rebuild();
  }
  double* store(int b, int face) {
    const std::ptrdiff_t o = offset_[static_cast<std::size_t>(b * FACES + face)];
    return o < 0 ? nullptr : values_.data() + o;
  }

  /// Applies weight * div(mean of the fine fluxes - own flux) to `field` where blocks meet finer ones. Collective.
  void correct(CellField field, double weight);

  /// Calls apply(b, face, difference) for every face with finer blocks behind it; difference = mean of the fine
  /// fluxes - own flux. Faces of one block are visited in order by one thread. Collective.
  template <class Apply>
  void reflux(Apply&& apply) {
    exchange();
    parallel_for(static_cast<int>(coarse_blocks_.size()), [&](int i) {
      const CoarseBlock& c = coarse_blocks_[static_cast<std::size_t>(i)];
      thread_local std::vector<double> difference;
      for (int face = 0; face < FACES; ++face) {
        if (!face_difference(c, face, difference)) continue;
        apply(c.b, face, static_cast<const double*>(difference.data()));
      }
    });
  }

 private:
  struct Part {                     // one fine block behind a coarse face
    int face = 0;                   // of the coarse block
    IntVec child{};                 // place of the fine block
    std::ptrdiff_t values = -1;     // its fluxes here, or
    int message = -1;               // restricted fluxes in the message of a neighbouring rank
    std::ptrdiff_t packed = 0;
  };
  struct CoarseBlock {
    int b = 0;
    std::vector<Part> parts;
  };
  struct Message {
    int rank = 0;
    std::vector<std::ptrdiff_t> sends;  // offsets of fine fluxes in values_
    std::ptrdiff_t recv_faces = 0;
    std::vector<double> send, recv;
  };

  void rebuild();
  void exchange();
  bool face_difference(const CoarseBlock& c, int face, std::vector<double>& difference);
  void restrict_face(const double* fine, double* coarse) const;

  Mesh& mesh_;
  std::int64_t generation_ = -1;
  std::vector<std::ptrdiff_t> offset_;
  std::vector<double> values_;
  std::vector<CoarseBlock> coarse_blocks_;
  std::vector<Message> messages_;
};

}  // namespace dendrift::amr

#include "snapshot.hpp"

#include <algorithm>

#include "amr/loops.hpp"

namespace dendrift {

namespace {

// Calls f(array, first value in the snapshot) for all arrays of all blocks that a checkpoint holds.
template <class M, class F>
void for_arrays(M& mesh, F&& f) {
  const std::vector<int> kept = io::checkpointed(mesh.fields());
  const auto size = static_cast<std::size_t>(mesh.layout().size());
  amr::parallel_for(mesh.size(), [&](int b) {
    std::size_t first = static_cast<std::size_t>(b) * kept.size() * size;
    for (const int id : kept) {
      f(mesh.array(id, mesh.block(b).slot) - mesh.layout().interior(), first);
      first += size;
    }
  });
}

}  // namespace

void Snapshot::take(const amr::Mesh& mesh, io::RunState state) {
  tree_ = mesh.tree();
  owners_.assign(mesh.owners().begin(), mesh.owners().end());
  state_ = std::move(state);
  values_.resize(io::checkpointed(mesh.fields()).size() * static_cast<std::size_t>(mesh.layout().size()) *
                 static_cast<std::size_t>(mesh.size()));
  for_arrays(mesh, [&](const double* array, std::size_t first) { std::copy_n(array, mesh.layout().size(), values_.data() + first); });
}

void Snapshot::restore(amr::Mesh& mesh) const {
  for (const amr::Block& b : mesh.blocks()) mesh.release_slot(b.slot);
  mesh.install(*tree_, owners_, std::vector<int>(owners_.size(), -1));
  for_arrays(mesh, [&](double* array, std::size_t first) { std::copy_n(values_.data() + first, mesh.layout().size(), array); });
}

}  // namespace dendrift

#include "snapshot.hpp"

#include <algorithm>

#include "amr/loops.hpp"

namespace dendrift {

namespace {

// Calls f(field, array, first value in the snapshot) for all arrays of local block b that a checkpoint holds.
template <class M, class F>
void for_arrays(M& mesh, int b, F&& f) {
  const auto size = static_cast<std::size_t>(mesh.layout().size());
  std::size_t kept = 0, each = 0;
  for (int id = 0; id < mesh.fields().size(); ++id) each += mesh.fields().row(id).checkpoint ? size : 0;
  for (int id = 0; id < mesh.fields().size(); ++id) {
    if (!mesh.fields().row(id).checkpoint) continue;
    f(mesh.array(id, mesh.block(b).slot) - mesh.layout().interior(), static_cast<std::size_t>(b) * each + kept);
    kept += size;
  }
}

}  // namespace

void Snapshot::take(const amr::Mesh& mesh, io::RunState state) {
  tree_ = mesh.tree();
  owners_.assign(mesh.owners().begin(), mesh.owners().end());
  state_ = std::move(state);
  std::size_t arrays = 0;
  for (int id = 0; id < mesh.fields().size(); ++id) arrays += mesh.fields().row(id).checkpoint ? 1 : 0;
  values_.resize(arrays * static_cast<std::size_t>(mesh.layout().size()) * static_cast<std::size_t>(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    for_arrays(mesh, b, [&](const double* array, std::size_t first) { std::copy_n(array, mesh.layout().size(), values_.data() + first); });
  });
}

void Snapshot::restore(amr::Mesh& mesh) const {
  for (const amr::Block& b : mesh.blocks()) mesh.release_slot(b.slot);
  mesh.install(*tree_, owners_, std::vector<int>(owners_.size(), -1));
  amr::parallel_for(mesh.size(), [&](int b) {
    for_arrays(mesh, b, [&](double* array, std::size_t first) { std::copy_n(values_.data() + first, mesh.layout().size(), array); });
  });
}

}  // namespace dendrift

/// \file
/// A state kept in memory, to go back to.
#pragma once

#include <optional>
#include <vector>

#include "amr/mesh.hpp"
#include "io/checkpoint.hpp"

namespace dendrift {

/// What a checkpoint holds, where it is: leaves, owners, and the fields of the blocks of this rank.
class Snapshot {
 public:
  bool empty() const { return !tree_; }
  void take(const amr::Mesh& mesh, io::RunState state);
  /// The state at that time, which must not be empty.
  const io::RunState& state() const { return state_; }
  /// Gives the mesh its leaves and fields back. Ghosts and what regridding does not carry are to be filled anew.
  void restore(amr::Mesh& mesh) const;
  std::int64_t bytes() const { return static_cast<std::int64_t>(values_.size() * sizeof(double)); }

 private:
  std::optional<amr::Tree> tree_;
  std::vector<int> owners_;
  std::vector<double> values_;  // by block, field
  io::RunState state_;
};

}  // namespace dendrift

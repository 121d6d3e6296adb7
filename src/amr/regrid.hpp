/// \file
/// Changing the mesh: refining, coarsening, and moving blocks between ranks.
#pragma once

#include <functional>
#include <span>
#include <vector>

#include "amr/ghost.hpp"
#include "amr/mesh.hpp"
#include "amr/partition.hpp"

namespace dendrift::amr {

/// What a block asks for.
struct Tag {
  int level = 0;             ///< level that its own cells need
  int keep = 0;              ///< level below which it must not be coarsened (hysteresis); >= level
  std::uint32_t reach = 0;   ///< bit d: cells near direction d need `reach_level` over there too
  int reach_level = 0;
  double weight = 1;         ///< cost of a step of this block
};

struct RegridOptions {
  Partitioner partitioner = Partitioner::curve;
  double max_imbalance = 1.1;  ///< largest load over mean load before blocks move between ranks
};

/// New tree from one tag a local block. Collective; every rank returns the same tree and weights per new leaf.
struct Proposal {
  Tree tree;
  std::vector<double> weights;
  bool changed = false;
};
Proposal propose(const Mesh& mesh, std::span<const Tag> tags);

/// Changes the mesh to `proposal`: transferred fields are prolonged and restricted conservatively, blocks that
/// stay keep their arrays untouched. Fields with Transfer::none are zero in new blocks. Collective. Returns
/// true if the tree or any owner changed.
bool regrid(Mesh& mesh, GhostExchange& ghosts, const Proposal& proposal, const RegridOptions& options);

/// Moves blocks so that leaf i belongs to owners[i]; all transferred fields travel. Collective.
void migrate(Mesh& mesh, const std::vector<int>& owners);

}  // namespace dendrift::amr

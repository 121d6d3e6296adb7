#include "amr/partition.hpp"

#include <metis.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>

namespace dendrift::amr {

std::vector<int> partition_curve(std::span<const double> weights, int ranks) {
  const double total = std::accumulate(weights.begin(), weights.end(), 0.0);
  std::vector<int> owners(weights.size(), 0);
  double before = 0;
  for (std::size_t i = 0; i < weights.size(); ++i) {
    const double middle = before + 0.5 * weights[i];
    owners[i] = std::clamp(static_cast<int>(middle / total * ranks), 0, ranks - 1);
    before += weights[i];
  }
  return owners;
}

std::vector<int> partition_graph(const Tree& tree, std::span<const double> weights, int ranks) {
  const int size = tree.size();
  if (ranks == 1 || size <= ranks) return partition_curve(weights, ranks);
  const double largest = *std::max_element(weights.begin(), weights.end());
  std::vector<idx_t> offsets{0}, adjacent, edge_weights, vertex_weights;
  std::vector<FinerNeighbour> finer;
  for (int i = 0; i < size; ++i) {
    const double relative = weights[static_cast<std::size_t>(i)] / largest;
    vertex_weights.push_back(1 + static_cast<idx_t>(1000 * relative));
    for (int face = 0; face < FACES; ++face) {
      const int dir = direction_index(face_offset(face));
      const Neighbour n = tree.neighbour(i, dir);
      if (n.leaf == i) continue;  // a periodic axis of one block
      if (n.leaf >= 0) {
        adjacent.push_back(n.leaf);
        edge_weights.push_back(n.kind == Neighbour::Kind::same ? 1 << (DIM - 1) : 1);
      } else if (n.kind == Neighbour::Kind::finer) {
        finer.clear();
        tree.finer_neighbours(i, dir, finer);
        for (const FinerNeighbour& f : finer) {
          adjacent.push_back(f.leaf);
          edge_weights.push_back(1);
        }
      }
    }
    offsets.push_back(static_cast<idx_t>(adjacent.size()));
  }
  idx_t vertices = size, constraints = 1, parts = ranks, cut = 0;
  idx_t options[METIS_NOPTIONS];
  METIS_SetDefaultOptions(options);
  options[METIS_OPTION_SEED] = 1;
  std::vector<idx_t> part(static_cast<std::size_t>(size));
  const int status =
      METIS_PartGraphKway(&vertices, &constraints, offsets.data(), adjacent.data(), vertex_weights.data(), nullptr,
                          edge_weights.data(), &parts, nullptr, nullptr, options, &cut, part.data());
  if (status != METIS_OK) throw std::runtime_error("METIS could not partition the graph of blocks");
  return {part.begin(), part.end()};
}

std::vector<int> partition(Partitioner kind, const Tree& tree, std::span<const double> weights, int ranks) {
  return kind == Partitioner::graph ? partition_graph(tree, weights, ranks) : partition_curve(weights, ranks);
}

double imbalance(std::span<const double> weights, std::span<const int> owners, int ranks) {
  std::vector<double> load(static_cast<std::size_t>(ranks), 0.0);
  for (std::size_t i = 0; i < weights.size(); ++i) load[static_cast<std::size_t>(owners[i])] += weights[i];
  const double total = std::accumulate(load.begin(), load.end(), 0.0);
  return *std::max_element(load.begin(), load.end()) * ranks / total;
}

}  // namespace dendrift::amr

/// \file
/// Distribution of blocks over ranks. Pure functions of their arguments: every rank computes the same answer.
#pragma once

#include <span>
#include <vector>

#include "amr/tree.hpp"

namespace dendrift::amr {

enum class Partitioner : std::uint8_t { curve, graph };

/// Cuts the Morton curve into pieces of equal weight. weights: one a leaf, > 0. Returns the owner of each leaf.
std::vector<int> partition_curve(std::span<const double> weights, int ranks);

/// METIS k-way partition of the graph of blocks that touch through faces; edges weigh what they exchange.
std::vector<int> partition_graph(const Tree& tree, std::span<const double> weights, int ranks);

std::vector<int> partition(Partitioner kind, const Tree& tree, std::span<const double> weights, int ranks);

/// Largest load of a rank over the mean load; 1 is perfect.
double imbalance(std::span<const double> weights, std::span<const int> owners, int ranks);

}  // namespace dendrift::amr

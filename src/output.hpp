/// \file
/// From the fields of a run to a plotfile: all nodes of the tree, parents holding the means of their children.
#pragma once

#include <functional>
#include <span>
#include <string>
#include <vector>

#include "amr/mesh.hpp"
#include "io/plotfile.hpp"
#include "physics/scales.hpp"

namespace dendrift {

/// One component of a plotfile: values of the cells of local block b, packed, in the unit of the file.
struct PlotComponent {
  std::string name;
  std::function<void(int b, std::span<double> out)> values;
};

/// Collective.
void write_plot(const std::string& path, const amr::Mesh& mesh, const physics::Scales& scales, double time_s,
                std::int64_t step, const std::vector<PlotComponent>& components);

}  // namespace dendrift

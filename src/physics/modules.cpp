#include "physics/modules.hpp"

#include <algorithm>

#include "physics/flow.hpp"
#include "physics/grains.hpp"
#include "physics/orientation.hpp"
#include "physics/solidification.hpp"
#include "physics/transport.hpp"
#include "settings.hpp"

namespace dendrift::physics {

Modules make_modules(const Settings& s, std::vector<Seed>& seeds) {
  Modules m;
  if (s.has_flow() && s.flow.prescribed()) m.push_back(std::make_unique<PrescribedFlow>(s.flow, s.scales, seeds));
  if (s.has_flow() && !s.flow.prescribed()) m.push_back(std::make_unique<Flow>(s.flow, s.scales, seeds));
  if (s.has_flow() && !s.phase_field.rigid) m.push_back(std::make_unique<Transport>(s.scales.k));
  const bool oriented = !seeds.empty() && (s.schema.has_table("orientation") || several_orientations(seeds, s.has_flow()));
  const bool later = std::ranges::any_of(seeds, [](const Seed& seed) { return !seed.present; });
  if (seeds.size() > 1 || oriented || later) m.push_back(std::make_unique<Grains>(s.scales, s.phase_field, seeds));
  if (oriented) m.push_back(std::make_unique<Orientation>(s.orientation, seeds));
  m.push_back(std::make_unique<Solidification>(s.phase_field, s.solute, s.scales, seeds));
  return m;
}

}  // namespace dendrift::physics

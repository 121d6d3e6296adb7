/// \file
/// The list of modules, in the order in which they act within a step.
#pragma once

#include "physics/module.hpp"
#include "physics/seeds.hpp"

namespace dendrift {
class Settings;
}

namespace dendrift::physics {

/// The modules that the input asks for.
Modules make_modules(const Settings& settings, std::vector<Seed>& seeds);

}  // namespace dendrift::physics

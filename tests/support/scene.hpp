// Small scenes for tests, from TOML text.
#pragma once

#include <mpi.h>

#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include "settings.hpp"
#include "simulation.hpp"

namespace dendrift::test {

/// Settings and the simulation that refers to them.
struct Scene {
  explicit Scene(const std::string& toml, const std::vector<std::string>& overrides = {},
                 MPI_Comm comm = MPI_COMM_SELF) {
    settings.parse_text(toml, "test", overrides);
    simulation = std::make_unique<Simulation>(settings, comm);
  }
  Simulation* operator->() { return simulation.get(); }

  /// Steps to exactly t.
  void advance_to(double t) {
    while (simulation->time() < t * (1 - 1e-12)) {
      const double left = t - simulation->time();
      simulation->step(left / std::max(1.0, std::ceil(left / simulation->max_dt() - 1e-9)));
    }
  }

  Settings settings;
  std::unique_ptr<Simulation> simulation;
};

inline std::string vector_text(double x) {
  std::string s = "[" + std::to_string(x);
  for (int a = 1; a < DIM; ++a) s += ", " + std::to_string(x);
  return s + "]";
}

/// A quarter (octant) of a crystal in a corner of a mirror-sided box; `side` in W0.
inline std::string corner_crystal(double side, double dx, const std::string& more = "") {
  std::string s = "[run]\nend_time_tau0 = 1000\n[mesh]\ndim = " + std::to_string(DIM) +
                  "\nsize_W0 = " + vector_text(side) + "\ndx_W0 = " + std::to_string(dx) + "\n";
  for (const char* face : {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"})
    if (DIM == 3 || face[0] != 'z') s += std::string(face) + " = \"symmetry\"\n";
  return s + "[[seed]]\nposition_W0 = " + vector_text(0) + "\nradius_W0 = 10\n" + more;
}

/// A whole crystal in the middle of a periodic box.
inline std::string whole_crystal(double side, double dx, const std::string& more = "") {
  std::string s = "[run]\nend_time_tau0 = 1000\n[mesh]\ndim = " + std::to_string(DIM) +
                  "\nsize_W0 = " + vector_text(side) + "\ndx_W0 = " + std::to_string(dx) + "\n";
  for (const char* face : {"xlo", "xhi", "ylo", "yhi", "zlo", "zhi"})
    if (DIM == 3 || face[0] != 'z') s += std::string(face) + " = \"periodic\"\n";
  return s + "[[seed]]\nposition_W0 = " + vector_text(side / 2) + "\nradius_W0 = 10\n" + more;
}

}  // namespace dendrift::test

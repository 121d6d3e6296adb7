/// \file
/// What a piece of physics offers to the time step. A module is one header and one source; it is active when
/// its table stands in the input. Modules do not include each other: they meet through fields.
#pragma once

#include <memory>
#include <stdexcept>
#include <vector>

#include "amr/ghost.hpp"
#include "amr/mesh.hpp"
#include "amr/regrid.hpp"

namespace dendrift::physics {

/// The state has lost its meaning: not finite, out of bounds, or a solver that does not converge.
class NumericalError : public std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// What modules have to say for a line of diagnostics.csv.
struct Report {
  double max_speed = 0;       ///< W0/tau0
  double divergence_max = 0;  ///< largest |div v| dx over the largest |v|
  int flow_iterations = 0;
  double flow_residual = 0;   ///< largest force on a crystal that is left unbalanced, over its drag at the largest speed
};

/// The defaults do nothing. Times in tau0, lengths in W0.
class Module {
 public:
  virtual ~Module() = default;
  Module() = default;
  Module(const Module&) = delete;
  Module& operator=(const Module&) = delete;

  virtual const char* name() const = 0;
  /// Adds rows to the table of fields, before the mesh exists.
  virtual void declare(amr::FieldTable&) {}
  /// The mesh is there; look up the fields of other modules here.
  virtual void attach(amr::Mesh&, amr::GhostExchange&) {}
  /// Sets the fields of this module to their state at t = 0, interiors only. Called again on every mesh on
  /// the way to the first one.
  virtual void initialize() {}
  /// Recomputes whatever regridding does not carry (Transfer::none).
  virtual void after_regrid() {}
  /// Largest time step that this module takes.
  virtual double max_dt() const { return 1e30; }
  virtual void advance(double /*t*/, double /*dt*/, std::int64_t /*step*/) {}
  /// Called on all ranks before the blocks are tagged.
  virtual void before_tagging() {}
  /// Raises what local block b asks of the next mesh. Ghosts of the fields are filled.
  virtual void tag(int /*b*/, amr::Tag&) const {}
  /// Speed at which what tag() looks at travels through the mesh. Ghosts are filled. Collective; the same on all ranks.
  virtual double front_speed() { return 0; }
  virtual void report(Report&) const {}
  /// What a restart must know beside the fields, and giving it back. recall throws std::out_of_range if the list is too short
  /// or a count in it is none (remembered_count).
  virtual std::vector<double> memory() const { return {}; }
  virtual void recall(const std::vector<double>&) {}
  /// The steps after the recalled state led to a failure: intervals of its own begin small.
  virtual void be_careful() {}
};

using Modules = std::vector<std::unique_ptr<Module>>;

}  // namespace dendrift::physics

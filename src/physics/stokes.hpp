/// \file
/// Velocity and pressure of a fluid whose viscosity jumps by many powers of ten, solved together: eqs. (5), (6).
///
///   sigma v - div[nu (grad v + grad v^T)] + grad p = f,   div v = 0
///
/// Staggered: velocities on faces, pressure in cells, on all levels of the tree at once.
#pragma once

#include <functional>
#include <memory>

#include "amr/hierarchy.hpp"
#include "amr/krylov.hpp"
#include "amr/multigrid.hpp"

namespace dendrift::physics {

enum class Stress : std::uint8_t { symmetric, laplacian };

struct StokesOptions {
  Stress stress = Stress::symmetric;
  double tolerance = 1e-6;  ///< preconditioned residual over the norm of the velocity
  int max_iterations = 300;
};

struct StokesResult {
  int iterations = 0;
  bool converged = false;
  double error = 0;           ///< preconditioned residual over the norm of the velocity
  double divergence_max = 0;  ///< largest |div v| dx over the largest |v|
};

/// Solver for one mesh; build it anew when the mesh changes. Components of its fields: the velocities, then the pressure.
///
/// GMRES on the whole system. Preconditioner: one multigrid cycle on the viscous operator, all components together, and nu + sigma (-Lap)^-1 for the pressure (Cahouet & Chabard, Int. J. Numer. Methods
/// Fluids 8, 869 (1988)), the inverse Laplacian being one cycle as well.
class StokesSolver {
 public:
  static constexpr int PRESSURE = DIM;

  StokesSolver(const amr::Mesh& mesh, const StokesOptions& options);

  amr::Hierarchy& hierarchy() { return hierarchy_; }
  amr::HierarchyField& state() { return state_; }  ///< v and p; the first guess, then the solution, ghosts filled
  amr::HierarchyField& force() { return force_; }  ///< f on the faces of the leaves

  /// A component of the velocity on a wall. Through walls alone, as much must flow in as out.
  void set_wall_velocity(int axis, int face, const amr::SideValue& value) { state_.set_side(axis, face, value); }

  /// `phase(b, cell array)`: writes phi of local block b, two layers of ghosts included; `law(phi)`: the viscosity.
  void set_viscosity(const std::function<void(int b, double* phi)>& phase, const std::function<double(double)>& law);

  StokesResult solve(double sigma);
  /// Fills parents and ghosts of state(). Collective.
  void fill_state() { hierarchy_.make_composite(state_, amr::Layout::GHOSTS, false); }

 private:
  using Vector = amr::Gmres::Vector;
  void set_up_pieces();
  std::vector<amr::Links> velocity_links(double sigma) const;
  void apply(const amr::HierarchyField& x, const amr::HierarchyField* b, amr::HierarchyField& y) const;
  void precondition(amr::HierarchyField& r);
  void pack(const amr::HierarchyField& f, Vector& v) const;
  void unpack(const Vector& v, amr::HierarchyField& f) const;
  template <class F>
  void for_leaves(F&& f) const;
  void remove_mean_pressure(amr::HierarchyField& f) const;

  StokesOptions options_;
  const amr::Mesh& mesh_;
  amr::Hierarchy hierarchy_;
  std::vector<amr::Component> components_;
  amr::HierarchyField state_, force_, work_, image_, viscosity_, pressure_;
  std::unique_ptr<amr::Multigrid> velocity_cycle_, pressure_cycle_;
  amr::Pieces pieces_;
  amr::Gmres gmres_;
  double sigma_ = 0;
  bool closed_ = true;  // pressure known up to a constant
};

}  // namespace dendrift::physics

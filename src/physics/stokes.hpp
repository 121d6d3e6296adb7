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
#include "physics/rigid_bodies.hpp"
#include "physics/rigid_modes.hpp"

namespace dendrift::physics {

enum class Stress : std::uint8_t { symmetric, laplacian };

/// coupled: velocity and pressure together. projection: the velocity with the old pressure, then the pressure that takes
/// its divergence away (incremental pressure correction); cheap, and wrong by the splitting.
enum class Coupling : std::uint8_t { coupled, projection };

struct StokesOptions {
  Stress stress = Stress::symmetric;
  Coupling coupling = Coupling::coupled;
  int passes = 1;          ///< of the projection
  bool rotational = true;  ///< its pressure takes -nu div v as well (Timmermans, Minev & van de Vosse, 1996)
  double tolerance = 1e-6;  ///< preconditioned residual over the norm of the velocity
  int max_iterations = 300;
  amr::BottomSolver bottom = amr::BottomSolver::direct;  ///< of all cycles
};

struct StokesResult {
  int iterations = 0;
  bool converged = false;
  double error = 0;           ///< preconditioned residual over the norm of the velocity: of the coupled system, always
  double fastest = 0;         ///< largest component of v on a face
  double divergence_max = 0;  ///< largest |div v| dx over that
};

/// Solver for one mesh; build it anew when the mesh changes. Components of its fields: the velocities, then the pressure.
///
/// GMRES on the whole system. Preconditioner: rigid motions of crystals first (RigidModes), then one multigrid cycle on the
/// viscous operator, all components together, and nu + sigma (-Lap)^-1 for the pressure (Cahouet & Chabard, Int. J. Numer.
/// Methods Fluids 8, 869 (1988)), the inverse Laplacian being one cycle as well.
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

  /// Adds kappa (v - v_rigid) to the left side, kappa = law(phi on the face). v_rigid: for the faces of each body the rigid
  /// motion about its centre that leaves no net force and torque; 0 for those that are held, and without centres.
  void set_drag(const std::function<void(int b, double* phi)>& phase, const std::function<double(double)>& law,
                const std::vector<RealVec>& centres, const RigidBodies::Owners& owners = {});

  /// Crystals whose rigid motions the preconditioner is to know: they should be free to turn. Of the coupled solution only.
  void set_crystals(Neighbourhood n) { rigid_.build(hierarchy_, components_, std::move(n)); }

  StokesResult solve(double sigma);
  /// What the last solution leaves of the momentum equation, on the unknown faces of the leaves. Faces that finer leaves
  /// own, and those of walls, hold nothing of use.
  const amr::HierarchyField& residual() const { return image_; }
  /// The velocities alone, the pressure of state() held: sigma v - div[...] = f - grad p. Conjugate residuals round the
  /// cycle of the coupled solver; tolerance and `error` are of the true residual over the right-hand side, in the 2-norm and
  /// in the largest entry, or what the rounding of v leaves if that is more.
  StokesResult solve_momentum(double sigma);
  /// Fills parents and ghosts of state(). Collective.
  void fill_state() { hierarchy_.make_composite(state_, amr::Layout::GHOSTS, false); }

 private:
  using Vector = amr::Gmres::Vector;
  /// f(phi of local block b).
  template <class F>
  void with_phase(int b, const std::function<void(int, double*)>& phase, F&& f) const;
  void extend_viscosity(int g, int i);
  void set_up_pieces();
  std::vector<amr::Links> velocity_links(double sigma) const;
  void prepare_pressure();
  void momentum(int b, const Array<const double*>& v, const double* p, const Array<double*>& out) const;
  void apply(const amr::HierarchyField& x, const amr::HierarchyField* rhs, amr::HierarchyField& y);
  void precondition(amr::HierarchyField& r);
  void cycle_pressure(amr::HierarchyField& r);
  void cycle_velocity(amr::HierarchyField& r);
  void cycle_momentum(amr::HierarchyField& r);
  StokesResult project(Vector& x);
  void project_pass(Vector& x, StokesResult& result);
  void subtract_gradient(const amr::HierarchyField& p, double factor, amr::HierarchyField& v) const;
  void finish(const Vector& x, StokesResult& result);
  double speed(const Vector& x) const;
  double size(const Vector& x) const;
  void blank(Vector& v, bool pressures) const;
  amr::Pieces plain_pieces() const;
  void pack(const amr::HierarchyField& f, Vector& v) const;
  void unpack(const Vector& v, amr::HierarchyField& f) const;
  double rounding_of_momentum() const;
  template <class F>
  void for_leaves(F&& f) const {
    amr::parallel_for(mesh_.size(), [&](int b) {
      const auto [g, i] = hierarchy_.place_of_block(b);
      f(b, g, i, hierarchy_.grid(g).dx);
    });
  }
  void remove_mean_pressure(amr::HierarchyField& f) const;

  StokesOptions options_;
  const amr::Mesh& mesh_;
  amr::Hierarchy hierarchy_;
  std::vector<amr::Component> components_;
  amr::HierarchyField state_, force_, work_, image_, viscosity_, pressure_;
  std::unique_ptr<amr::HierarchyField> drag_, mobility_;  // on faces: kappa and 1/(sigma + kappa)
  RigidBodies bodies_;
  RigidModes rigid_;
  RigidModes::Momentum momentum_of_motion_;  // of block b, without pressure
  std::unique_ptr<amr::Multigrid> velocity_cycle_, pressure_cycle_;
  amr::Pieces pieces_;
  amr::Gmres gmres_, momentum_, poisson_;
  double sigma_ = 0, largest_drag_ = 0;
  bool closed_ = true;  // pressure known up to a constant
};

}  // namespace dendrift::physics

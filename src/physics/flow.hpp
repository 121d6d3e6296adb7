/// \file
/// The velocity of the melt and of the crystals in it: table [flow]; eqs. (5) and (6).
#pragma once

#include <algorithm>
#include <memory>
#include <optional>

#include "amr/coarser_mesh.hpp"
#include "io/config.hpp"
#include "physics/module.hpp"
#include "physics/scales.hpp"
#include "physics/seeds.hpp"
#include "physics/stokes.hpp"

namespace dendrift::physics {

/// How the viscosity goes from melt to solid, f = (1+phi)/2. h1, h2, h3: 1/nu = s/nu_s + (1-s)/nu_l with
/// s = f^n/(f^n + (1-f)^n): a solid of the size of phi = 0. linear: as printed; the solid then reaches far into the melt.
enum class ViscosityLaw : std::uint8_t { h1, h2, h3, linear };

/// Which excess of solute makes the melt heavy: what phi and c together hold (the print), or what the liquid
/// of the same U holds, which has no dip inside the interface.
enum class Buoyancy : std::uint8_t { mixture, liquid };

/// How the velocity of a wall is spread over it.
enum class Profile : std::uint8_t { uniform, parabolic };

/// What keeps solid rigid: its viscosity, or a resistance against everything but a rigid motion in a melt without solid.
enum class SolidModel : std::uint8_t { viscous, penalised };

enum class Motion : std::uint8_t { free, held };

using Gradient = std::array<double, std::size_t{DIM} * DIM>;  ///< row by row: dv_x/dx, dv_x/dy, ...

struct FlowOptions {
  std::optional<RealVec> velocity_um_s, velocity_w0_tau0;
  std::optional<Gradient> velocity_gradient_per_tau0;
  SolidModel solid = SolidModel::viscous;
  Motion motion = Motion::free;
  double viscosity_ratio = 1e6;
  ViscosityLaw viscosity = ViscosityLaw::h3;
  Stress stress = Stress::symmetric;
  double gravity_um_s2 = 1e7;
  double solutal_expansion_per_wt = 9.2e-3;
  double solid_density_ratio = 2.7 / 2.45;
  bool solutal_buoyancy = true, solid_weight = true, inertia = true;
  Buoyancy buoyancy = Buoyancy::mixture;
  Coupling coupling = Coupling::coupled;
  int projections = 1;
  bool rotational = true;
  double tolerance = 2e-6;
  amr::BottomSolver bottom = amr::BottomSolver::direct;
  int max_iterations = 300;
  int coarser_levels = 0;
  double courant = 0.5, max_interval_tau0 = 4, max_change = 0.05;
  std::array<std::optional<RealVec>, 6> wall_velocity_w0_tau0;  ///< those of z are read in 3D only
  std::array<Profile, 6> wall_profile{};
  std::optional<Gradient> wall_gradient_per_tau0;
  RealVec initial_velocity_w0_tau0{};
  double initial_vortex_w0_tau0 = 0;

  void declare(io::Schema& schema);
  bool prescribed() const { return velocity_um_s || velocity_w0_tau0 || velocity_gradient_per_tau0; }
  /// Component `axis` of the velocity on a side that is a wall.
  amr::SideValue wall_value(const amr::MeshShape& shape, int axis, int face) const;
  /// Melt flows in or out through a side: a wall that lets it, or a prescribed velocity, which heeds none.
  bool through_walls(const amr::MeshShape& shape) const;
  /// What these options ask of the sides of the box.
  void check_sides(io::Checks& checks, const amr::MeshShape& shape) const;
};

/// nu/nu_l for a given phi.
double relative_viscosity(ViscosityLaw law, double ratio, double phi);

/// kappa W0^2/nu_l for a given phi: .63 n^2 s/(1-s), n = 3, s = f^3/(f^3 + (1-f)^3), and no more than 100. A disc then has
/// the drag of one of its own radius.
double relative_drag(double phi);

/// Provides the face field "velocity" (W0/tau0): constant in time, affine in space, free of divergence.
class PrescribedFlow : public Module {
 public:
  PrescribedFlow(const FlowOptions& options, const Scales& scales, std::vector<Seed>& crystals);
  const char* name() const override { return "flow"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange&) override;
  void initialize() override { after_regrid(); }
  void after_regrid() override;
  void advance(double t, double dt, std::int64_t step) override;
  void report(Report& r) const override;

 private:
  RealVec velocity_at(const RealVec& x) const;

  RealVec velocity_{};
  Gradient gradient_{};
  std::vector<Seed>& crystals_;
  amr::FaceField v_;
  amr::Mesh* mesh_ = nullptr;
};

/// Provides "velocity" (W0/tau0) and "pressure" (of unit density, W0^2/tau0^2), and moves the crystals.
///
/// Backward Euler from one solution to the next, explicit for v.grad v. The flow is solved once in several steps of
/// growth: at the latest when the melt has moved by `courant` cells, when the velocity is expected to have changed by
/// `max_change`, and after every change of the tree.
class Flow : public Module {
 public:
  Flow(const FlowOptions& options, const Scales& scales, std::vector<Seed>& crystals);
  const char* name() const override { return "flow"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) override;
  void initialize() override;
  void after_regrid() override;
  double max_dt() const override;
  void advance(double t, double dt, std::int64_t step) override;
  void report(Report& r) const override;
  std::vector<double> memory() const override;
  void recall(const std::vector<double>& m) override;
  void be_careful() override;

 private:
  void solve(double elapsed);
  void choose_mesh();
  void make_solver();
  template <class F>
  void for_arrays(F&& f);
  void load();
  double tolerance() const;
  void store(double elapsed);
  void complete();
  void extrapolate(double elapsed);
  void set_viscosity();
  void set_crystals();
  bool held(const Seed& crystal) const { return options_.motion == Motion::held || crystal.held; }
  bool penalised() const {
    return options_.solid == SolidModel::penalised || std::ranges::any_of(crystals_, [this](const Seed& s) { return held(s); });
  }
  void set_force(double sigma);
  void add_inertia(int b);
  double unbalanced() const;
  Array<bool> unheld() const;
  RealVec means(const amr::HierarchyField& f) const;
  void shift(amr::HierarchyField& f, const RealVec& by, const Array<bool>& axes);

  std::vector<int> bodies_;  // Neighbourhood::body at the last solution
  FlowOptions options_;
  Scales scales_;
  std::vector<Seed>& crystals_;
  double solutal_, weight_;  // alpha_c c_l and rho_s/rho_l - 1, times the switches
  RealVec gravity_{};  // W0/tau0^2
  struct Fields {
    amr::CellField psi, c, grain, pressure, pressure_rate;  // grain: id -1 where there is one crystal
    amr::FaceField v, v_rate;
  };
  Fields phase_, now_;  // on the mesh of the phase, and on that of the solver
  amr::Mesh *phase_mesh_ = nullptr, *mesh_ = nullptr;
  amr::GhostExchange *phase_ghosts_ = nullptr, *ghosts_ = nullptr;
  std::unique_ptr<amr::CoarserMesh> coarser_;  // where mesh_ is not that of the phase
  std::unique_ptr<amr::GhostExchange> coarser_ghosts_;
  std::unique_ptr<StokesSolver> solver_;
  std::vector<amr::BlockIndex> leaves_;  // of the tree that the velocity belongs to
  double last_ = 0, next_ = 0, interval_ = 0;
  double fastest_ = 0, unbalanced_ = 0;
  bool due_ = false, recalled_ = false;
  StokesResult result_;
};

}  // namespace dendrift::physics

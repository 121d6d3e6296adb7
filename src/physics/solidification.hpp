/// \file
/// Growth: phase and solute advanced together. They are two tables of the input and two rows of the field table
/// but one sweep over memory, because the antitrapping current needs the rate of the phase at both sides of
/// every face.
#pragma once

#include <array>

#include "amr/flux_register.hpp"
#include "physics/local_axes.hpp"
#include "physics/module.hpp"
#include "physics/phase_field.hpp"
#include "physics/solute.hpp"

namespace dendrift::physics {

/// One Runge-Kutta-Legendre step of first order (Meyer, Balsara & Aslam, J. Comput. Phys. 257, 594 (2014)) in as
/// many stages as diffusion needs for stability; s stages reach (s^2+s)/2 explicit steps.
class Solidification : public Module {
 public:
  Solidification(const PhaseFieldOptions& phase, const SoluteOptions& solute, const Scales& scales,
                 const std::vector<Seed>& crystals);

  const char* name() const override { return "solidification"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) override;
  void initialize() override;
  void after_regrid() override { initializing_ = false; }
  double max_dt() const override;
  void advance(double t, double dt, std::int64_t step) override;
  void before_tagging() override;
  void tag(int b, amr::Tag& tag) const override;
  double front_speed() override;
  std::vector<double> memory() const override { return {fastest_}; }
  void recall(const std::vector<double>& m) override { fastest_ = m.at(0); }

  /// Fewest stages with which a step of dt is stable.
  int stages(double dt) const;
  /// Largest step of a single explicit stage on the finest level, from diffusion.
  double explicit_limit() const;
  /// Largest step of s stages of the phase, from the speed of the front when the mesh was last looked at.
  double sharpening_limit(int s) const;
  /// Largest step of s stages from all of these and the input.
  double largest_step(int s) const;
  const AlloyParameters& parameters() const { return parameters_; }

 private:
  void turn_axes();
  void draw(const std::vector<Seed>& crystals);
  AlloyBlock block_arrays(int b) const;
  void run_stage(const Stage& stage, double noise, std::uint64_t noise_key, bool measure);

  PhaseFieldOptions phase_;
  SoluteOptions solute_;
  Scales scales_;
  const std::vector<Seed>& crystals_;
  AlloyParameters parameters_;
  LocalAxes local_axes_;
  amr::CellField psi_, c_, psi_other_, c_other_;
  amr::FaceField velocity_;  // id -1: no flow
  amr::Mesh* mesh_ = nullptr;
  amr::GhostExchange* ghosts_ = nullptr;
  std::unique_ptr<amr::FluxRegister> fluxes_;
  bool initializing_ = true;
  double across_ = 1;   // stiffness of the solute's equation across the interface
  double fastest_ = 0;  // rate of psi in the interface when last looked at: the speed of the front
  std::vector<std::array<double, 2>> block_cost_;  // seconds, kind; of this rank's blocks
  std::array<double, 3> kind_cost_{0.2, 0.1, 1.0};  // relative cost of a block by BlockKind, measured
};

}  // namespace dendrift::physics

/// \file
/// The flow carries phase and solute: v.grad phi of eq. (1) and div(v c) of eq. (2).
#pragma once

#include <memory>

#include "amr/flux_register.hpp"
#include "physics/module.hpp"

namespace dendrift::physics {

/// Third-order upwind in space, three-stage Runge-Kutta in time (Wicker & Skamarock, Mon. Weather Rev. 130, 2088
/// (2002)). psi, smooth across the interface, is carried as it is. c moves by fluxes, so that no solute is lost:
/// flux = v A(phi_f) [1+(1-k) U_f], A = [1+k-(1-k)phi]/2, with A(phi_f) taken from psi to fourth order, so that c
/// follows phi and a uniform U stays uniform, and U_f limited (Koren), so that U makes no new extremes.
/// Takes as many steps of its own as the velocity needs within a step of growth.
/// Reads the face field "velocity" and the cell fields psi and c.
class Transport : public Module {
 public:
  explicit Transport(double partition_coefficient) : k_(partition_coefficient) {}
  const char* name() const override { return "transport"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) override;
  void advance(double t, double dt, std::int64_t step) override;
  double front_speed() override;

 private:
  /// Phase and solute of one moment of a step.
  struct Moment {
    amr::CellField psi, c;
  };
  void measure();
  void carry(double dt);
  void stage(const Moment& base, const Moment& from, const Moment& to, double dt);
  void carry_phase(int b, const Moment& base, const Moment& from, const Moment& to, double dt) const;
  void carry_solute(int b, const Moment& base, const Moment& from, const Moment& to, double dt);

  double k_;
  Moment now_, first_, second_;
  amr::FaceField v_;
  amr::Mesh* mesh_ = nullptr;
  amr::GhostExchange* ghosts_ = nullptr;
  std::unique_ptr<amr::FluxRegister> fluxes_;
  double fastest_ = 0;       // largest |v|
  double largest_rate_ = 0;  // largest sum over axes of |v_a|/dx, 1/tau0
};

}  // namespace dendrift::physics

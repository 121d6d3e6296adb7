/// \file
/// The velocity of the melt and of the crystals in it: table [flow]. So far the velocity is prescribed.
#pragma once

#include <optional>

#include "io/config.hpp"
#include "physics/module.hpp"
#include "physics/scales.hpp"

namespace dendrift::physics {

struct FlowOptions {
  std::optional<RealVec> velocity_um_s, velocity_w0_tau0;

  void declare(io::Schema& schema);
};

/// Provides the face field "velocity" (W0/tau0), so far uniform.
class PrescribedFlow : public Module {
 public:
  PrescribedFlow(const FlowOptions& options, const Scales& scales);
  const char* name() const override { return "flow"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange&) override { mesh_ = &mesh; }
  void initialize() override { after_regrid(); }
  void after_regrid() override;

  const RealVec& velocity() const { return velocity_; }

 private:
  RealVec velocity_{};
  amr::FaceField v_;
  amr::Mesh* mesh_ = nullptr;
};

}  // namespace dendrift::physics

#include "physics/flow.hpp"

#include <algorithm>

#include "amr/loops.hpp"

namespace dendrift::physics {

void FlowOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("flow", "velocity of melt and crystals, prescribed; without this table nothing moves");
  t.reals("velocity_um_s", velocity_um_s).unit("um/s").doc("uniform velocity; or velocity_W0_tau0");
  t.reals("velocity_W0_tau0", velocity_w0_tau0).unit("W0/tau0").doc("uniform velocity");
  schema.check({"flow"}, [this](io::Checks& checks) {
    if (checks.has_table("flow") && velocity_um_s.has_value() == velocity_w0_tau0.has_value())
      checks.fail("flow", "exactly one of velocity_um_s and velocity_W0_tau0", velocity_um_s ? "both" : "neither");
  });
}

PrescribedFlow::PrescribedFlow(const FlowOptions& o, const Scales& scales) {
  for (int a = 0; a < DIM; ++a)
    velocity_[a] = o.velocity_w0_tau0 ? (*o.velocity_w0_tau0)[a] : (*o.velocity_um_s)[a] * scales.tau0_s / scales.w0_um;
}

void PrescribedFlow::declare(amr::FieldTable& fields) {
  amr::FieldSpec f;
  f.name = "velocity";
  f.symbol = "v";
  f.unit = "W0/tau0";
  f.doc = "velocity, normal component on each face";
  v_ = fields.add_face(f);
}

void PrescribedFlow::after_regrid() {
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    for (int axis = 0; axis < DIM; ++axis) {
      double* v = mesh_->faces(v_, axis, b) - layout.interior();
      std::fill_n(v, layout.size(), velocity_[axis]);
    }
  });
}

}  // namespace dendrift::physics

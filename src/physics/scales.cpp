#include "physics/scales.hpp"

#include <cmath>

namespace dendrift::physics {

void AlloyOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("alloy", "dilute binary alloy, isothermal", io::Schema::Presence::implied);
  t.real("partition_coefficient", partition_coefficient).above(0).below(1).doc("k = c_s/c_l at equilibrium");
  t.real("c0_wt", c0_wt).unit("wt%").above(0).below(100).doc("mean concentration of the melt");
  t.real("liquidus_slope_K_per_wt", liquidus_slope_k_per_wt)
      .unit("K/wt%")
      .below(0)
      .doc("slope of the liquidus line, negative for k < 1");
  t.real("gibbs_thomson_um_K", gibbs_thomson_um_k).unit("um K").above(0).doc("Gibbs-Thomson coefficient");
  t.real("diffusivity_um2_s", diffusivity_um2_s).unit("um2/s").above(0).doc("of the solute in the liquid");
  t.real("viscosity_um2_s", viscosity_um2_s)
      .unit("um2/s")
      .above(0)
      .doc("kinematic viscosity of the melt; a prescribed flow does not use it");
  t.real("supersaturation", supersaturation)
      .above(0)
      .below(1)
      .doc("Omega = (c_l - c0)/[(1-k) c_l]; far from the crystals U = -Omega");
  t.real("W0_over_d0", width_over_d0)
      .range(0.5, 100)
      .doc("interface width over capillary length; 10 to 20 cost no accuracy, 30 about 2 % of the tip");
}

Scales::Scales(const AlloyOptions& a) {
  constexpr double A1 = 0.8839, A2 = 0.6267;  // Karma & Rappel, Phys. Rev. E 57, 4323 (1998)
  k = a.partition_coefficient;
  supersaturation = a.supersaturation;
  c_l_wt = a.c0_wt / (1 - (1 - k) * supersaturation);
  d0_um = a.gibbs_thomson_um_k / (std::abs(a.liquidus_slope_k_per_wt) * c_l_wt * (1 - k));
  w0_um = a.width_over_d0 * d0_um;
  lambda = A1 * a.width_over_d0;
  diffusivity = A2 * lambda;
  tau0_s = diffusivity * w0_um * w0_um / a.diffusivity_um2_s;
  viscosity = a.viscosity_um2_s * tau0_s / (w0_um * w0_um);
}

}  // namespace dendrift::physics

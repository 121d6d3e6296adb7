/// \file
/// The alloy and the units in which everything else is computed: W0 for lengths, tau0 for times.
#pragma once

#include "amr/dim.hpp"
#include "io/config.hpp"

namespace dendrift::physics {

/// Table [alloy]: dilute binary alloy, isothermal. Defaults: Al-4wt%Cu, Table 1 of Qi et al., Sci. Rep. 7,
/// 45770 (2017).
struct AlloyOptions {
  double partition_coefficient = 0.14;
  double c0_wt = 4.0;
  double liquidus_slope_k_per_wt = -2.65;
  double gibbs_thomson_um_k = 0.236;
  double diffusivity_um2_s = 2400;
  double viscosity_um2_s = 5e5;
  double supersaturation = 0.2;
  double width_over_d0 = 10;

  void declare(io::Schema& schema);
};

/// Derived from the alloy by the thin-interface relations of Karma, Phys. Rev. Lett. 87, 115701 (2001).
struct Scales {
  double k = 0;            ///< partition coefficient
  double supersaturation = 0;
  double c_l_wt = 0;       ///< liquidus concentration c0/[1-(1-k)Omega], the unit of c
  double d0_um = 0;        ///< capillary length Gamma/(|m| c_l (1-k)); the print has c0, see docs/verification.md
  double w0_um = 0;        ///< unit of length
  double tau0_s = 0;       ///< unit of time, 0.6267 lambda W0^2/D
  double lambda = 0;       ///< 0.8839 W0/d0
  double diffusivity = 0;  ///< D tau0/W0^2 = 0.6267 lambda
  double viscosity = 0;    ///< nu tau0/W0^2 of the melt

  explicit Scales(const AlloyOptions& alloy);
  Scales() = default;
  double speed_um_s(double speed) const { return speed * w0_um / tau0_s; }
};

}  // namespace dendrift::physics

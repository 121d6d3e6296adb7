/// \file
/// The solute: table [solute]. c is conserved; U is recovered from c and phi. Eqs. (2) and (3).
#pragma once

#include "amr/mesh.hpp"
#include "amr/regrid.hpp"
#include "io/config.hpp"
#include "physics/alloy_kernel.hpp"
#include "physics/scales.hpp"

namespace dendrift::physics {

struct SoluteOptions {
  Antitrapping antitrapping = Antitrapping::material;
  double refine_jump = 0.01;

  void declare(io::Schema& schema);
};

/// The row of c in the table of fields.
amr::FieldSpec solute_field();

/// U = -Omega everywhere, c following phi and U, in the interior of block b.
void set_uniform_supersaturation(amr::Mesh& mesh, amr::CellField psi, amr::CellField c, const Scales& scales, int b);

/// Asks for the level on which U changes by less than refine_jump from cell to cell, outside the solid.
void tag_solute(const amr::Mesh& mesh, amr::CellField psi, amr::CellField c, const Scales& scales,
                const SoluteOptions& options, int b, amr::Tag& tag);

}  // namespace dendrift::physics

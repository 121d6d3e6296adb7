/// \file
/// The phase: table [phase_field]. Its variable is psi, with phi = tanh(psi/sqrt 2); eq. (1).
#pragma once

#include "amr/mesh.hpp"
#include "amr/regrid.hpp"
#include "io/config.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

struct PhaseFieldOptions {
  double anisotropy = 0.05;
  bool frozen = false, rigid = false;
  double max_dt_tau0 = 0.24;
  double noise = 0;
  std::int64_t noise_seed = 1;
  double refine_gradient_w0 = 0.015;
  int buffer_cells = 4;

  void declare(io::Schema& schema);
  /// |psi| within which |grad phi| W0 exceeds refine_gradient_w0, |grad psi| being 1 there.
  double band() const;
};

/// The row of psi in the table of fields.
amr::FieldSpec psi_field();

/// psi of the nearest seed, held within the bounds of the kernel, in the interior of block b.
void set_seeds(amr::Mesh& mesh, amr::CellField psi, const std::vector<Seed>& seeds, int b);

/// Asks for the finest level where the interface is or may come within `buffer_cells`.
void tag_interface(const amr::Mesh& mesh, amr::CellField psi, const PhaseFieldOptions& options, int b, amr::Tag& tag);

/// The same for seeds that a coarse block may be too coarse to see.
void tag_seeds(const amr::Mesh& mesh, const std::vector<Seed>& seeds, double band, int b, amr::Tag& tag);

}  // namespace dendrift::physics

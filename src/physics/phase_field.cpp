#include "physics/phase_field.hpp"

#include <algorithm>
#include <cmath>

#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"

namespace dendrift::physics {

void PhaseFieldOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("phase_field", "Karma's phase field, eq. (1)", io::Schema::Presence::implied);
  t.real("anisotropy", anisotropy).range(0, 0.06).doc("eps4 of a_s = (1-3 eps)(1 + 4 eps/(1-3 eps) sum n_i^4); convex below 1/15");
  t.boolean("frozen", frozen).doc("no growth and no diffusion: crystals are only carried by the flow");
  t.boolean("rigid", rigid)
      .doc("frozen crystals keep the shape of their seeds: drawn anew where their motion takes them, U = -Omega everywhere; nothing else is carried");
  schema.check({"phase_field"}, [this](io::Checks& checks) {
    if (rigid && !frozen) checks.fail("phase_field.rigid", "only together with frozen = true");
  });
  t.real("max_dt_tau0", max_dt_tau0).unit("tau0").above(0).at_most(1).doc("largest step of phase and solute; stable below about .3, whatever the spacing");
  t.real("noise", noise).at_least(0).at_most(10).doc("amplitude of a uniform random rate of psi in the interface, per sqrt(tau0 W0^d); 0: none");
  t.integer("noise_seed", noise_seed).doc("of the counter-based generator");
  t.real("refine_gradient_W0", refine_gradient_w0)
      .unit("1/W0")
      .range(1e-4, 0.2)
      .doc("cells with a larger |grad phi| are kept on the finest level");
  t.integer("buffer_cells", buffer_cells).range(2, 8).doc("cells of the finest level around them, so that no front leaves it between regrids");
}

double PhaseFieldOptions::band() const {
  // |grad phi| = (1 - phi^2)/sqrt 2 where |grad psi| = 1
  return SQRT2 * std::atanh(std::sqrt(std::max(0.0, 1 - SQRT2 * refine_gradient_w0)));
}

amr::FieldSpec psi_field() {
  amr::FieldSpec f;
  f.name = "psi";
  f.symbol = "psi";
  f.unit = "W0";
  f.doc = "phase variable, phi = tanh(psi/sqrt 2); the signed distance to a straight interface";
  f.transfer = amr::Transfer::conservative;
  f.checkpoint = true;
  return f;
}

void set_seeds(amr::Mesh& mesh, amr::CellField psi, const std::vector<Seed>& seeds, int b) {
  const amr::Block& block = mesh.block(b);
  const amr::Layout& layout = mesh.layout();
  double* p = mesh.cells(psi, b);
  const std::vector<std::size_t> near = deepest(seeds, mesh.shape(), block.middle(layout.n), block.ball(layout.n));
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& c) {
    double value = -PSI_MAX;
    for (const std::size_t g : near) value = std::max(value, seeds[g].depth(mesh.shape().way(seeds[g].position, block.centre(c))));
    p[layout.offset(c)] = std::min(value, PSI_MAX);
  });
}

void tag_interface(const amr::Mesh& mesh, amr::CellField psi, const PhaseFieldOptions& options, int b, amr::Tag& tag) {
  const amr::Layout& layout = mesh.layout();
  const double* p = mesh.cells(psi, b);
  const int finest = mesh.shape().max_level;
  // A coarse cell is tagged if the interface may pass through it.
  const double band = options.band() + (mesh.block(b).index.level < finest ? mesh.block(b).dx : 0.0);
  bool near = false;
  amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
    const double* q = p + layout.offset(row);
    double least = PSI_MAX;
    for (int i = 0; i < layout.n; ++i) least = std::min(least, std::abs(q[i]));
    if (least >= std::min(band, PSI_MAX)) return;
    near = true;
    IntVec c = row;
    for (c[0] = 0; c[0] < layout.n; ++c[0]) {
      if (std::abs(q[c[0]]) >= std::min(band, PSI_MAX)) continue;
      for (int d = 0; d < DIRECTIONS; ++d) {
        const IntVec o = direction_offset(d);
        bool close = true;
        for (int a = 0; a < DIM; ++a) {
          if (o[a] < 0 && c[a] >= options.buffer_cells) close = false;
          if (o[a] > 0 && c[a] < layout.n - options.buffer_cells) close = false;
        }
        if (close) tag.reach |= 1U << d;
      }
    }
  });
  if (near) tag.level = tag.keep = tag.reach_level = finest;
}

void tag_seeds(const amr::Mesh& mesh, const std::vector<Seed>& seeds, double band, int b, amr::Tag& tag) {
  const amr::Block& block = mesh.block(b);
  const double side = mesh.layout().n * block.dx;
  for (const Seed& s : seeds) {
    double near2 = 0, far2 = 0;
    for (int a = 0; a < DIM; ++a) {
      double lo = block.lo[a] - s.position[a];
      if (mesh.shape().periodic()[a]) {
        const double extent = mesh.shape().hi()[a] - mesh.shape().lo[a];
        lo -= std::round((lo + 0.5 * side) / extent) * extent;
      }
      const double hi = lo + side;
      const double near = std::max({0.0, lo, -hi}), far = std::max(std::abs(lo), std::abs(hi));
      near2 += near * near;
      far2 += far * far;
    }
    const auto [along, across] = s.semi_axes();
    if (std::sqrt(near2) < std::max(along, across) + band && std::sqrt(far2) > std::min(along, across) - band)
      tag.level = tag.keep = mesh.shape().max_level;
  }
}

}  // namespace dendrift::physics

#include "physics/solute.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "amr/loops.hpp"

namespace dendrift::physics {

void SoluteOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("solute", "transport of solute, eqs. (2) and (3)", io::Schema::Presence::implied);
  t.choice("antitrapping", antitrapping,
           {{"material", Antitrapping::material}, {"eulerian", Antitrapping::eulerian}, {"none", Antitrapping::none}})
      .doc("rate in the antitrapping current: of phi along the flow; at a fixed point, as printed (not Galilean "
           "invariant); or no current");
  t.real("refine_jump", refine_jump)
      .above(0)
      .at_most(1)
      .doc("change of U from cell to cell above which the melt is refined");
}

amr::FieldSpec solute_field() {
  amr::FieldSpec f;
  f.name = "c";
  f.symbol = "c";
  f.unit = "c_l";
  f.doc = "concentration of solute, conserved";
  f.transfer = amr::Transfer::conservative;
  f.checkpoint = true;
  return f;
}

void set_uniform_supersaturation(amr::Mesh& mesh, amr::CellField psi, amr::CellField c, const Scales& scales, int b) {
  const amr::Layout& layout = mesh.layout();
  const double* p = mesh.cells(psi, b);
  double* out = mesh.cells(c, b);
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
    const std::ptrdiff_t q = layout.offset(cell);
    out[q] = c_of_u(-scales.supersaturation, phi_of_psi(p[q]), scales.k);
  });
}

void tag_solute(const amr::Mesh& mesh, amr::CellField psi, amr::CellField c, const Scales& scales,
                const SoluteOptions& options, int b, amr::Tag& tag) {
  const amr::Layout& layout = mesh.layout();
  const double* p = mesh.cells(psi, b);
  const double* q = mesh.cells(c, b);
  // Differences between neighbours that are both liquid, ghost cells included: there U is linear in c.
  constexpr double LIQUID = -4.0;
  double jump = 0;
  const double to_u = 1 / (1 - scales.k);
  amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
    const std::ptrdiff_t o = layout.offset(row);
    for (int a = 0; a < DIM; ++a) {
      const std::ptrdiff_t s = layout.stride(a);
      for (std::ptrdiff_t i = o; i < o + layout.n; ++i) {
        if (p[i] > LIQUID || p[i + s] > LIQUID) continue;
        jump = std::max(jump, std::abs(q[i + s] - q[i]) * to_u);
      }
    }
  });
  const int level = mesh.block(b).index.level;
  // One level down doubles the jump; coarsen only if the result stays clear of the limit.
  const int wanted = level + (jump > options.refine_jump ? 1 : 0);
  const int kept = level - (2 * jump < 0.7 * options.refine_jump ? 1 : 0);
  const int finest = mesh.shape().max_level;
  tag.level = std::max(tag.level, std::min(wanted > level ? wanted : kept, finest));
  tag.keep = std::max(tag.keep, std::min(kept, finest));
}

}  // namespace dendrift::physics

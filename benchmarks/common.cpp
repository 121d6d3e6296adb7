#include "common.hpp"

#include "physics/phase_field.hpp"
#include "physics/solute.hpp"

namespace dendrift::bench {

amr::MeshShape Blocks::shape(int cells, int block_cells, double dx) {
  amr::MeshShape s;
  s.root_blocks = filled(cells / block_cells);
  s.block_cells = block_cells;
  s.root_dx = dx;
  s.sides.fill(amr::Side::symmetry);
  return s;
}

amr::FieldTable Blocks::fields() {
  amr::FieldTable t;
  psi_ = t.add_cell(physics::psi_field());
  c_ = t.add_cell(physics::solute_field());
  amr::FieldSpec other;
  other.name = "psi_other";
  psi_next_ = t.add_cell(other);
  other.name = "c_other";
  c_next_ = t.add_cell(other);
  return t;
}

Blocks::Blocks(int cells, int block_cells, double dx)
    : mesh_(shape(cells, block_cells, dx), fields(), MPI_COMM_SELF), ghosts_(mesh_) {}

physics::AlloyBlock Blocks::arrays(int b) {
  physics::AlloyBlock k;
  k.psi = mesh_.cells(psi_, b);
  k.c = mesh_.cells(c_, b);
  k.psi_next = mesh_.cells(psi_next_, b);
  k.c_next = mesh_.cells(c_next_, b);
  k.dx = mesh_.block(b).dx;
  return k;
}

void Blocks::swap() {
  mesh_.swap(psi_, psi_next_);
  mesh_.swap(c_, c_next_);
}

void set_sample(Blocks& blocks) {
  for (int pass = 0; pass < 2; ++pass) {
    for (int b = 0; b < blocks.size(); ++b)
      blocks.for_each(b, [&](const IntVec& cell, std::ptrdiff_t q) {
        const Sample s(cell);
        blocks.psi(b)[q] = s.psi;
        blocks.c(b)[q] = s.c;
      });
    blocks.fill_ghosts();
    blocks.swap();
  }
}

void set_sample(PlainAlloy& plain) {
  for (int pass = 0; pass < 2; ++pass) {
    amr::for_each_cell({}, filled(plain.cells()), [&](const IntVec& cell) {
      const Sample s(cell);
      plain.psi()[plain.offset(cell)] = s.psi;
      plain.c()[plain.offset(cell)] = s.c;
    });
    plain.fill_ghosts();
    plain.swap();
  }
}

double kernel_minus_plain(int block_cells) {
  constexpr int N = DIM == 2 ? 128 : 64;
  Blocks blocks(N, block_cells, DX);
  PlainAlloy plain(N, DX);
  set_sample(blocks);
  set_sample(plain);
  double worst = 0;
  for (int j = 1; j <= 4; ++j) {
    const physics::Stage stage{(1.0 - j) / j, (2.0 * j - 1) / j * 0.02};
    blocks.fill_ghosts();
    for (int b = 0; b < blocks.size(); ++b)
      physics::advance_alloy(blocks.arrays(b), physics::BlockKind::interface, alloy(), stage, block_cells);
    blocks.swap();
    plain.fill_ghosts();
    plain.advance(alloy(), stage);
    plain.swap();
    for (int b = 0; b < blocks.size(); ++b)
      blocks.for_each(b, [&](const IntVec& cell, std::ptrdiff_t q) {
        const std::ptrdiff_t p = plain.offset(cell);
        // A maximum would let a NaN pass.
        const double d = std::abs(blocks.psi(b)[q] - plain.psi()[p]) + std::abs(blocks.c(b)[q] - plain.c()[p]);
        if (!(d <= worst)) worst = d;
      });
  }
  return worst;
}

}  // namespace dendrift::bench

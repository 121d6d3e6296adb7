#include "guard.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"

namespace dendrift {

namespace {

constexpr double LEAST_C = -0.1;  // of c_l: what limited transport may undershoot in one cell, and more

// Of a row of n cells. No branch, so that it costs a stream over the row: x - x is all bits zero for finite numbers
// only, and the sign of a difference tells what is out of bounds.
bool row_holds(const double* psi, const double* c, int n, double max_c) {
  const auto bits = [](double x) { return std::bit_cast<std::uint64_t>(x); };
  std::uint64_t not_finite = 0, signs = 0;
  for (int i = 0; i < n; ++i) {
    const double both = psi[i] + c[i];
    not_finite |= bits(both - both);
    signs |= bits(c[i] - LEAST_C) | bits(max_c - c[i]);
  }
  return not_finite == 0 && signs >> 63 == 0;
}

std::string text_of(const RealVec& x) {
  std::string text;
  for (int a = 0; a < DIM; ++a) text += fmt::format("{}{:.6g}", a == 0 ? "(" : ", ", x[a]);
  return text + ")";
}

// Values in the plane through the cell, two cells to each side within the block; then what the block holds.
std::string around(const amr::Mesh& mesh, amr::CellField psi, amr::CellField c, int b, const IntVec& cell) {
  const amr::Layout& layout = mesh.layout();
  const amr::Block& block = mesh.block(b);
  constexpr int REACH = 2;
  std::string text = fmt::format("block on level {} at {} W0, dx {:.6g} W0; phi, c/c_l around the cell (y downwards):\n",
                                 block.index.level, text_of(block.lo), block.dx);
  for (int j = REACH; j >= -REACH; --j) {
    for (int i = -REACH; i <= REACH; ++i) {
      IntVec q = cell;
      q[0] += i;
      q[1] += j;
      if (std::min(q[0], q[1]) < 0 || std::max(q[0], q[1]) >= layout.n) {
        text += fmt::format("{:20}", "-");
        continue;
      }
      const std::ptrdiff_t o = layout.offset(q);
      text += fmt::format("  {:7.4f},{:10.4g}", physics::phi_of_psi(mesh.cells(psi, b)[o]), mesh.cells(c, b)[o]);
    }
    text += '\n';
  }
  int bad = 0;
  double least = 1e300, most = -1e300;
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
    const double value = mesh.cells(c, b)[layout.offset(q)];
    if (!std::isfinite(value) || !std::isfinite(mesh.cells(psi, b)[layout.offset(q)])) {
      ++bad;
      return;
    }
    least = std::min(least, value);
    most = std::max(most, value);
  });
  text += fmt::format("cells of the block that are not finite: {}; c/c_l of the others from {:.4g} to {:.4g}", bad, least, most);
  return text;
}

}  // namespace

void GuardOptions::declare(io::Schema& schema) {
  io::Table& t = schema.table("guard", "states that make no sense", io::Schema::Presence::implied);
  t.integer("snapshot_every_steps", snapshot_every_steps)
      .at_least(0)
      .doc("steps between the states kept in memory to go back to after a failure; 0: none, the first failure ends the run");
  t.integer("max_retries", max_retries)
      .at_least(0)
      .doc("failures one after the other, each answered by going back and halving the step, before the run ends");
  t.real("max_c", max_c).above(1).doc("largest composition over c_l that makes sense");
  t.real("max_solute_drift", max_solute_drift).above(0).doc("relative change of all solute in a closed box that makes sense");
  t.real("min_dt_tau0", min_dt_tau0).unit("tau0").above(0).doc("a step below is a failure");
}

std::optional<std::string> find_fault(const amr::Mesh& mesh, amr::CellField psi, amr::CellField c, double max_c,
                                      const std::string& when) {
  const amr::Layout& layout = mesh.layout();
  std::vector<char> sick(static_cast<std::size_t>(mesh.size()), 0);
  amr::parallel_for(mesh.size(), [&](int b) {
    const double *p = mesh.cells(psi, b), *u = mesh.cells(c, b);
    bool holds = true;
    amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
      const std::ptrdiff_t o = layout.offset(row);
      holds = row_holds(p + o, u + o, layout.n, max_c) && holds;
    });
    sick[static_cast<std::size_t>(b)] = holds ? 0 : 1;
  });
  const auto first = std::ranges::find(sick, 1);
  const double none = std::numeric_limits<double>::max();
  const int b = static_cast<int>(first - sick.begin());
  const double mine = first == sick.end() ? none : mesh.block(b).leaf, least = amr::global_min(mine, mesh.comm());
  if (least == none) return std::nullopt;
  std::string text;
  if (mine == least) {
    bool found = false;
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
      const std::ptrdiff_t o = layout.offset(q);
      const double p = mesh.cells(psi, b)[o], u = mesh.cells(c, b)[o];
      if (found || row_holds(&p, &u, 1, max_c)) return;
      found = true;
      const char* what = std::isfinite(p) && std::isfinite(u) ? "c is out of bounds" : "phi or c is not finite";
      text = fmt::format("{} {}, at {} W0: phi = {:.6g}, c/c_l = {:.6g}\n{}", what, when, text_of(mesh.block(b).centre(q)),
                         physics::phi_of_psi(p), u, around(mesh, psi, c, b, q));
    });
  }
  const std::vector<char> all = amr::all_gather(std::span<const char>(text.data(), text.size()), mesh.comm());
  return std::string(all.begin(), all.end());
}

bool Caution::may_retry(double time, std::int64_t step) {
  ++failures_;
  failed_at_ = std::max(failed_at_, time);
  if (++tries_ > max_retries_) return false;
  factor_ *= 0.5;
  calm_until_ = step + patience_;
  patience_ *= 2;
  return true;
}

void Caution::settle(double time, std::int64_t step) {
  if (time <= failed_at_) return;
  tries_ = 0;
  if (factor_ == 1 || step < calm_until_) return;
  factor_ *= 2;
  calm_until_ = step + patience_;
}

}  // namespace dendrift

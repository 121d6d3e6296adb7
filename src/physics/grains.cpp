#include "physics/grains.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <set>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"

namespace dendrift::physics {

namespace {

constexpr double MARKED = 1;       // psi of phi = .61: solid enough to have a marker; softer, it is sheared by the melt
constexpr double TOUCHED = -2.0821;  // psi of phi = -.9, on both sides of a contact

std::size_t at(int i) { return static_cast<std::size_t>(i); }

}  // namespace

Grains::Grains(const Scales& scales, const PhaseFieldOptions& phase, std::vector<Seed>& crystals)
    : scales_(scales), phase_(phase), crystals_(crystals) {}

void Grains::declare(amr::FieldTable& fields) {
  amr::FieldSpec f;
  f.transfer = amr::Transfer::conservative;
  f.mixing = amr::Mixing::labels;
  f.checkpoint = true;
  f.name = "grain";
  f.doc = "number of the crystal that a cell belongs to, or is nearest to";
  grain_ = fields.add_cell(f);
  f.unit = "W0";
  f.doc = "from the centre of a cell to the marker of its crystal";
  for (int a = 0; a < DIM; ++a) {
    f.name = std::string("marker_") + "xyz"[a];
    shift_[a] = fields.add_cell(f);
  }
  f.transfer = amr::Transfer::none;
  f.checkpoint = false;
  f.doc = "the same after cells have taken new markers; scratch";
  f.name = "grain_next";
  grain_next_ = fields.add_cell(f);
  for (int a = 0; a < DIM; ++a) {
    f.name = std::string("marker_next_") + "xyz"[a];
    shift_next_[a] = fields.add_cell(f);
  }
}

void Grains::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  psi_.id = mesh.fields().find("psi").value();
  c_.id = mesh.fields().find("c").value();
  v_.id = mesh.fields().find("velocity_x").value_or(-1);
}

RealVec Grains::from_centre(const Seed& seed, const amr::Block& block, const IntVec& cell) const {
  return mesh_->shape().way(seed.position, block.centre(cell));
}

// The crystal that a cell lies in, or whose surface is nearest.
void Grains::initialize() {
  const amr::Layout& layout = mesh_->layout();
  amr::parallel_for(mesh_->size(), [&](int b) {
    double* grain = mesh_->cells(grain_, b);
    const amr::Block& block = mesh_->block(b);
    const std::vector<std::size_t> near = deepest(crystals_, mesh_->shape(), block.middle(layout.n), block.ball(layout.n));
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
      double most = -1e300;
      for (const std::size_t g : near) {
        const double depth = crystals_[g].depth(from_centre(crystals_[g], block, cell));
        if (depth <= most) continue;
        most = depth;
        grain[layout.offset(cell)] = static_cast<double>(g);
      }
      for (const amr::CellField f : shift_) mesh_->cells(f, b)[layout.offset(cell)] = 0;
    });
  });
}

void Grains::advance(double t, double dt, std::int64_t) {
  nucleate(t);
  // A front passes a cell in some ten steps; the melt ahead of it must have its label by then.
  constexpr int MOST_STEPS = 4;
  constexpr double FAR = 0.3;  // cells
  ++waited_;
  const double moved = v_.id >= 0 ? move_markers(dt) : 0.0;
  if (moved < FAR && waited_ < MOST_STEPS) return;
  waited_ = 0;
  if (phase_.rigid) {  // crystals keep the shapes of their seeds
    initialize();
    ghosts_->fill({psi_});
  } else {
    assign();
  }
  find_contacts();
}

// Largest distance of a marker from its cell's centre, in cells.
double Grains::move_markers(double dt) {
  const amr::Layout& layout = mesh_->layout();
  std::vector<double> most(at(mesh_->size()), 0.0);
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double* psi = mesh_->cells(psi_, b);
    for (int a = 0; a < DIM; ++a) {
      const double* v = mesh_->faces(v_, a, b);
      double* shift = mesh_->cells(shift_[a], b);
      const std::ptrdiff_t s = layout.stride(a);
      double largest = 0;
      amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
        const std::ptrdiff_t o = layout.offset(row);
        for (std::ptrdiff_t q = o; q < o + layout.n; ++q) {
          if (psi[q] <= MARKED) continue;
          shift[q] += dt * 0.5 * (v[q] + v[q + s]);
          largest = std::max(largest, std::abs(shift[q]));
        }
      });
      most[at(b)] = std::max(most[at(b)], largest / mesh_->block(b).dx);
    }
  });
  return amr::global_max(most.empty() ? 0.0 : *std::max_element(most.begin(), most.end()), mesh_->comm());
}

void Grains::assign() {
  std::vector<amr::CellField> fields{psi_, grain_};
  fields.insert(fields.end(), shift_.begin(), shift_.end());
  ghosts_->fill(fields);
  amr::parallel_for(mesh_->size(), [&](int b) { assign_block(b); });
  mesh_->swap(grain_, grain_next_);
  for (int a = 0; a < DIM; ++a) mesh_->swap(shift_[a], shift_next_[a]);
}

void Grains::assign_block(int b) {
  const amr::Layout& layout = mesh_->layout();
  const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
  double* next = mesh_->cells(grain_next_, b);
  Array<const double*> shift{};
  Array<double*> shift_next{};
  for (int a = 0; a < DIM; ++a) {
    shift[a] = mesh_->cells(shift_[a], b);
    shift_next[a] = mesh_->cells(shift_next_[a], b);
  }
  if (amr::uniform(grain, layout)) {  // wherever the markers are, they say the same: start afresh
    amr::for_each_row(filled(layout.n), [&](const IntVec& row) {
      const std::ptrdiff_t o = layout.offset(row);
      std::copy_n(grain + o, layout.n, next + o);
      for (int a = 0; a < DIM; ++a) std::fill_n(shift_next[a] + o, layout.n, 0.0);
    });
    return;
  }
  const double dx = mesh_->block(b).dx;
  const auto stride = [&](int direction) {
    std::ptrdiff_t s = 0;
    for (int a = 0; a < DIM; ++a) s += direction_offset(direction)[a] * layout.stride(a);
    return s;
  };
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
    const std::ptrdiff_t q = layout.offset(cell);
    std::ptrdiff_t from = q;
    RealVec place{};
    if (psi[q] <= MARKED) {
      for (int d = 0; d < DIRECTIONS; ++d)
        if (const std::ptrdiff_t p = q + stride(d); psi[p] > psi[from]) from = p;
    } else {
      double nearest = 1e300;
      const auto consider = [&](int d) {
        const std::ptrdiff_t p = q + stride(d);
        if (psi[p] <= MARKED) return;
        double square = 0;
        RealVec x{};
        for (int a = 0; a < DIM; ++a) {
          x[a] = direction_offset(d)[a] * dx + shift[a][p];
          square += x[a] * x[a];
        }
        if (square >= nearest) return;
        nearest = square;
        from = p;
        place = x;
      };
      consider(CENTRE);  // its own, if others are no nearer
      for (int d = 0; d < DIRECTIONS; ++d)
        if (d != CENTRE) consider(d);
    }
    next[q] = grain[from];
    for (int a = 0; a < DIM; ++a) shift_next[a][q] = place[a];
  });
}

void Grains::find_contacts() {
  struct Pair {
    int low, high, firm;  // firm: phi > 0 on both sides
    auto operator<=>(const Pair&) const = default;
  };
  const amr::Layout& layout = mesh_->layout();
  ghosts_->fill({grain_});  // those of psi are there
  std::vector<std::set<Pair>> parts(at(mesh_->size()));
  amr::parallel_for(mesh_->size(), [&](int b) {
    const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
    if (amr::uniform(grain, layout)) return;
    for (int a = 0; a < DIM; ++a) {
      const std::ptrdiff_t s = layout.stride(a);
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
        const std::ptrdiff_t q = layout.offset(cell);
        const double thinnest = std::min(psi[q], psi[q + s]);
        if (grain[q] == grain[q + s] || thinnest < TOUCHED) return;
        const auto [low, high] = std::minmax({static_cast<int>(grain[q]), static_cast<int>(grain[q + s])});
        parts[at(b)].insert({low, high, thinnest > 0 ? 1 : 0});
      });
    }
  });
  std::set<Pair> mine;
  for (const std::set<Pair>& part : parts) mine.insert(part.begin(), part.end());
  const std::vector<Pair> list(mine.begin(), mine.end());
  std::vector<Pair> all = amr::all_gather(std::span<const Pair>(list), mesh_->comm());
  std::ranges::sort(all);
  all.erase(std::unique(all.begin(), all.end()), all.end());
  for (Seed& s : crystals_) {
    s.touching = false;
    s.contacts = 0;
  }
  for (const Pair& p : all)
    for (const int g : {p.low, p.high}) {
      crystals_[at(g)].touching = true;
      crystals_[at(g)].contacts += p.firm;
    }
}

// f(block, cell, distance from the seed's surface, positive inside) for cells no further than `reach` outside it.
template <class F>
void Grains::near_seed(const Seed& seed, double reach, F&& f) const {
  const auto [along, across] = seed.semi_axes();
  const double far = std::max(along, across) + reach;
  amr::parallel_for(mesh_->size(), [&](int b) {
    const amr::Block& block = mesh_->block(b);
    const double half = 0.5 * mesh_->layout().n;
    const RealVec middle = from_centre(seed, block, {});
    double least = 0;  // distance of the block's nearest corner
    for (int a = 0; a < DIM; ++a) {
      const double x = std::max(0.0, std::abs(middle[a] + (half - 0.5) * block.dx) - half * block.dx);
      least += x * x;
    }
    if (least > far * far) return;
    amr::for_each_cell({}, filled(mesh_->layout().n), [&](const IntVec& cell) {
      const double depth = seed.depth(from_centre(seed, block, cell));
      if (depth > -reach) f(b, mesh_->layout().offset(cell), depth);
    });
  });
}

bool Grains::undercooled(const Seed& seed) const {
  constexpr double AROUND = 2;  // W0
  std::vector<char> bad(at(mesh_->size()), 0);
  near_seed(seed, AROUND, [&](int b, std::ptrdiff_t q, double) {
    const double psi = mesh_->cells(psi_, b)[q];
    if (psi > TOUCHED || u_of_c(mesh_->cells(c_, b)[q], phi_of_psi(psi), scales_.k) >= 0) bad[at(b)] = 1;
  });
  return !amr::global_any(std::ranges::find(bad, 1) != bad.end(), mesh_->comm());
}

void Grains::nucleate(double t) {
  for (std::size_t g = 0; g < crystals_.size(); ++g) {
    Seed& seed = crystals_[g];
    if (seed.present || seed.refused || seed.nucleation_time > t * (1 + 1e-12)) continue;
    seed.present = undercooled(seed);
    seed.refused = !seed.present;
    if (seed.present) draw(g);
    if (seed.refused && mesh_->rank() == 0)
      fmt::print("t {:.6g} s: seed {} does not appear: the melt there is not undercooled liquid\n", t * scales_.tau0_s, g);
  }
}

// psi of the seed where that is larger; U stays as it is, and the solute that solid cannot hold goes to the melt around.
void Grains::draw(std::size_t number) {
  const Seed& seed = crystals_[number];
  const double reach = 6 * seed.radius;  // a thinner ring would be so enriched that the seed melts
  std::vector<std::array<double, 2>> parts(at(mesh_->size()));  // solute set free; room for it
  const auto cell_volume = [&](int b) { return std::pow(mesh_->block(b).dx, DIM); };
  near_seed(seed, reach, [&](int b, std::ptrdiff_t q, double depth) {
    double &psi = mesh_->cells(psi_, b)[q], &c = mesh_->cells(c_, b)[q];
    if (depth > psi) {
      const double before = c, u = u_of_c(c, phi_of_psi(psi), scales_.k);
      psi = std::min(depth, PSI_MAX);
      c = c_of_u(u, phi_of_psi(psi), scales_.k);
      parts[at(b)][0] += cell_volume(b) * (before - c);
      mesh_->cells(grain_, b)[q] = static_cast<double>(number);
      for (const amr::CellField f : shift_) mesh_->cells(f, b)[q] = 0;
    }
    parts[at(b)][1] += cell_volume(b) * 0.5 * (1 - phi_of_psi(psi));
  });
  std::vector<amr::ExactSum> sums(2);
  for (const auto& part : parts)
    for (std::size_t k = 0; k < 2; ++k) sums[k].add(part[k]);
  const std::vector<double> total = amr::exact_sums(sums, mesh_->comm());
  const double rise = total[0] / total[1];
  near_seed(seed, reach, [&](int b, std::ptrdiff_t q, double) {
    mesh_->cells(c_, b)[q] += rise * 0.5 * (1 - phi_of_psi(mesh_->cells(psi_, b)[q]));
  });
}

void Grains::before_tagging() { ghosts_->fill({grain_}); }

// Boundaries between crystals stay on the finest level, and places where crystals are still to come.
void Grains::tag(int b, amr::Tag& tag) const {
  const amr::Layout& layout = mesh_->layout();
  const double *psi = mesh_->cells(psi_, b), *grain = mesh_->cells(grain_, b);
  const int finest = mesh_->shape().max_level;
  if (!amr::uniform(grain, layout))
    for (int a = 0; a < DIM; ++a) {
      const std::ptrdiff_t s = layout.stride(a);
      amr::for_each_cell(filled(-1), filled(layout.n + 1), [&](const IntVec& cell) {
        const std::ptrdiff_t q = layout.offset(cell);
        if (grain[q] != grain[q + s] && psi[q] > TOUCHED && psi[q + s] > TOUCHED) tag.level = tag.keep = finest;
      });
    }
  for (const Seed& s : crystals_) {
    if (s.present || s.refused) continue;
    tag_seeds(*mesh_, {s}, phase_.band(), b, tag);
  }
}

}  // namespace dendrift::physics

#include "physics/rigid_modes.hpp"

#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

// Gap over radius below which a crystal's translations are felt by its neighbours, or stopped by them.
constexpr double CROWDED = 1;

// The axis of a component of the potential, and that component.
constexpr int axis_of(int component) { return DIM == 2 ? 2 : component; }
constexpr int component_of(int axis) { return DIM == 2 ? 0 : axis; }

// Arrays of a block, as the mesh's; what they held is lost.
class Scratch {
 public:
  void fit(const amr::Layout& layout) {
    origin_ = layout.interior();
    for (auto& x : data_) x.resize(at(static_cast<int>(layout.size())));
  }
  Array<double*> write() {
    Array<double*> p;
    for (int a = 0; a < DIM; ++a) p[a] = data_[a].data() + origin_;
    return p;
  }
  Array<const double*> read() const {
    Array<const double*> p;
    for (int a = 0; a < DIM; ++a) p[a] = data_[a].data() + origin_;
    return p;
  }

 private:
  Array<std::vector<double>> data_;
  std::ptrdiff_t origin_ = 0;
};

// Calls f(offset, size, r) for rows of edges along the potential's component (2D: corners): parts there are means of p[0] and
// p[step]; r is the place of the first.
template <class F>
void for_each_row_of_edges(const Corners& corners, int component, double dx, const RealVec& first, F&& f) {
  IntVec size = filled(corners.pitch());
  RealVec r0 = first;
  std::ptrdiff_t step = 0;
  if constexpr (DIM == 3) {
    --size[component];
    r0[component] += 0.5 * dx;
    step = corners.stride(component);
  }
  amr::for_each_row(size, [&](const IntVec& row) {
    RealVec r = r0;
    std::ptrdiff_t offset = 0;
    for (int a = 1; a < DIM; ++a) {
      r[a] += row[a] * dx;
      offset += row[a] * corners.stride(a);
    }
    f(offset, size[0], step, r);
  });
}

}  // namespace

void RigidModes::build(const amr::Hierarchy& hierarchy, const std::vector<amr::Component>& velocities, Neighbourhood neighbourhood) {
  hierarchy_ = &hierarchy;
  components_.assign(velocities.begin(), velocities.begin() + DIM);
  neighbourhood_ = std::move(neighbourhood);
  first_.clear();
  count_.clear();
  size_ = 0;
  for (const Neighbourhood::Crystal& c : neighbourhood_.crystals) {
    first_.push_back(size_);
    count_.push_back(c.radius == 0 ? 0 : c.gap < CROWDED * c.radius ? MOST : TURNS);
    size_ += count_.back();
  }
}

// Coefficients: rates of rotation, velocity, and in 2D the flow round the crystal.
std::array<RigidModes::Polynomial, RigidModes::TURNS> RigidModes::potential(std::size_t crystal, const Coefficients& c) const {
  std::array<Polynomial, TURNS> list;
  const double* velocity = c.data() + TURNS;
  for (int k = 0; k < TURNS; ++k) {
    Polynomial& p = list[at(k)];
    p.square = -c[at(k)];
    if constexpr (DIM == 2) {
      p.linear[0] = -velocity[1];
      p.linear[1] = velocity[0];
      p.constant = c[at(MOST - 1)] * neighbourhood_.crystals[crystal].radius;
    } else {
      const int a = (k + 1) % 3, b = (k + 2) % 3;
      p.linear[b] = 0.5 * velocity[a];
      p.linear[a] = -0.5 * velocity[b];
    }
  }
  return list;
}

// From the crystal's centre to the first of a block's corners.
RealVec RigidModes::first_corner(int b, std::size_t crystal) const {
  const amr::Mesh& mesh = hierarchy_->mesh();
  const amr::Block& block = mesh.block(b);
  const double half = 0.5 * mesh.layout().n * block.dx;
  RealVec r = mesh.shape().way(neighbourhood_.crystals[crystal].centre, block.middle(mesh.layout().n));
  for (double& x : r) x -= half + block.dx;
  return r;
}

// Z c on the faces of a block and one layer of ghosts; coefficients(crystal) -> c of this crystal. False: there is none.
template <class C>
bool RigidModes::velocity(int b, C&& coefficients, const Array<double*>& v) const {
  const auto& shares = neighbourhood_.shares[at(b)];
  if (shares.empty()) return false;
  const amr::Layout& layout = hierarchy_->mesh().layout();
  const Corners corners{layout.n};
  const double dx = hierarchy_->mesh().block(b).dx;
  thread_local std::array<std::vector<double>, TURNS> sums;
  for (auto& s : sums) s.assign(corners.count(), 0.0);
  for (const Neighbourhood::Share& share : shares) {
    const std::size_t crystal = at(share.crystal);
    const Coefficients c = coefficients(crystal);
    if (std::ranges::all_of(c, [](double x) { return x == 0; })) continue;
    const RealVec first = first_corner(b, crystal);
    const std::array<Polynomial, TURNS> list = potential(crystal, c);
    for (int k = 0; k < TURNS; ++k) {
      const Polynomial& p = list[at(k)];
      for_each_row_of_edges(corners, k, dx, first, [&](std::ptrdiff_t offset, int size, std::ptrdiff_t step, const RealVec& r) {
        double constant = p.constant, square = 0;
        for (int a = 1; a < DIM; ++a) {
          constant += p.linear[a] * r[a];
          square += r[a] * r[a];
        }
        const double *part = share.part.data() + offset, *next = part + step;
        double* to = sums[at(k)].data() + offset;
#pragma omp simd
        for (int i = 0; i < size; ++i) {
          const double x = r[0] + i * dx;
          to[i] += 0.5 * (part[i] + next[i]) * (constant + p.linear[0] * x + 0.5 * p.square * (x * x + square));
        }
      });
    }
  }
  const double h = 1 / dx;
  for (int a = 0; a < DIM; ++a) {
    IntVec size = filled(layout.n + 2);
    ++size[a];
    const int c = (a + 1) % 3, d = (a + 2) % 3;  // v_a = dA_d/dx_c - dA_c/dx_d
    amr::for_each_row(size, [&](const IntVec& row) {
      IntVec q = row;
      for (int& i : q) --i;
      const std::ptrdiff_t o = corners.offset(q);
      double* to = v[a] + layout.offset(q);
      if (c < DIM) {
        const double *p = sums[at(component_of(d))].data() + o, *up = p + corners.stride(c);
        for (int i = 0; i < size[0]; ++i) to[i] = h * (up[i] - p[i]);
      } else {
        for (int i = 0; i < size[0]; ++i) to[i] = 0;
      }
      if (d < DIM) {
        const double *p = sums[at(component_of(c))].data() + o, *up = p + corners.stride(d);
        for (int i = 0; i < size[0]; ++i) to[i] -= h * (up[i] - p[i]);
      }
    });
  }
  return true;
}

// The adjoint of the curl: what forces r on a block's own faces do to the potentials at its corners.
void RigidModes::curl_of(int b, const Array<const double*>& r, std::vector<double>& curl) const {
  const amr::Layout& layout = hierarchy_->mesh().layout();
  const auto [g, i] = hierarchy_->place_of_block(b);
  const Corners corners{layout.n};
  const double dx = hierarchy_->mesh().block(b).dx, weight = std::pow(dx, DIM - 1);
  curl.assign(TURNS * corners.count(), 0.0);
  for (int a = 0; a < DIM; ++a) {
    const amr::Range range = hierarchy_->unknowns(g, i, components_[at(a)], true);
    const int c = (a + 1) % 3, d = (a + 2) % 3;
    amr::for_each_row(range.size, [&](const IntVec& row) {
      IntVec q = row;
      for (int e = 0; e < DIM; ++e) q[e] += range.lo[e];
      const std::ptrdiff_t o = corners.offset(q);
      const double* from = r[a] + layout.offset(q);
      if (c < DIM) {
        double *w = curl.data() + at(component_of(d)) * corners.count() + o, *up = w + corners.stride(c);
        for (int k = 0; k < range.size[0]; ++k) up[k] += weight * from[k];
        for (int k = 0; k < range.size[0]; ++k) w[k] -= weight * from[k];
      }
      if (d < DIM) {
        double *w = curl.data() + at(component_of(c)) * corners.count() + o, *up = w + corners.stride(d);
        for (int k = 0; k < range.size[0]; ++k) up[k] -= weight * from[k];
        for (int k = 0; k < range.size[0]; ++k) w[k] += weight * from[k];
      }
    });
  }
}

// With all modes of a crystal.
RigidModes::Coefficients RigidModes::products(int b, const Neighbourhood::Share& share, const std::vector<double>& curl) const {
  const Corners corners{hierarchy_->mesh().layout().n};
  const double dx = hierarchy_->mesh().block(b).dx;
  const std::size_t crystal = at(share.crystal);
  const RealVec first = first_corner(b, crystal);
  std::array<Polynomial, TURNS> moments;  // of 1, r and r^2/2
  for (int k = 0; k < TURNS; ++k) {
    Polynomial& m = moments[at(k)];
    for_each_row_of_edges(corners, k, dx, first, [&](std::ptrdiff_t offset, int size, std::ptrdiff_t step, const RealVec& r) {
      const double *part = share.part.data() + offset, *next = part + step;
      const double* w = curl.data() + at(k) * corners.count() + offset;
      double sum = 0, linear = 0, square = 0;
#pragma omp simd reduction(+ : sum, linear, square)
      for (int i = 0; i < size; ++i) {
        const double x = r[0] + i * dx, f = 0.5 * (part[i] + next[i]) * w[i];
        sum += f;
        linear += f * x;
        square += f * x * x;
      }
      double rest = 0;
      for (int a = 1; a < DIM; ++a) {
        m.linear[a] += sum * r[a];
        rest += r[a] * r[a];
      }
      m.constant += sum;
      m.linear[0] += linear;
      m.square += 0.5 * (square + rest * sum);
    });
  }
  Coefficients result{};
  for (int mode = 0; mode < MOST; ++mode) {
    Coefficients unit{};
    unit[at(mode)] = 1;
    const std::array<Polynomial, TURNS> list = potential(crystal, unit);
    for (std::size_t k = 0; k < TURNS; ++k) {
      result[at(mode)] += list[k].constant * moments[k].constant + list[k].square * moments[k].square;
      for (int a = 0; a < DIM; ++a) result[at(mode)] += list[k].linear[a] * moments[k].linear[a];
    }
  }
  return result;
}

// Of the last take_from.
RigidModes::Coefficients RigidModes::known(std::size_t crystal) const {
  Coefficients c{};
  std::copy_n(amounts_.begin() + first_[crystal], count_[crystal], c.begin());
  return c;
}

void RigidModes::prepare(const Momentum& momentum) {
  if (empty()) return;
  const amr::Mesh& mesh = hierarchy_->mesh();
  // Z^T K Z, block by block: of each pair of shares the products of all modes.
  std::vector<std::vector<std::array<Coefficients, MOST>>> parts(at(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    const auto& shares = neighbourhood_.shares[at(b)];
    thread_local Scratch v, image;
    thread_local std::vector<double> curl;
    v.fit(mesh.layout());
    image.fit(mesh.layout());
    parts[at(b)].resize(shares.size() * shares.size());
    for (std::size_t s = 0; s < shares.size(); ++s)
      for (int mode = 0; mode < count_[at(shares[s].crystal)]; ++mode) {
        velocity(
            b,
            [&](std::size_t crystal) {
              Coefficients unit{};
              if (crystal == at(shares[s].crystal)) unit[at(mode)] = 1;
              return unit;
            },
            v.write());
        momentum(b, v.read(), image.write());
        curl_of(b, image.read(), curl);
        for (std::size_t t = 0; t < shares.size(); ++t)
          parts[at(b)][s * shares.size() + t][at(mode)] = products(b, shares[t], curl);
      }
  });
  // Pairs of crystals that meet in a block anywhere, in order.
  using Pair = std::array<int, 2>;
  std::vector<Pair> pairs;
  const auto sort = [&] {
    std::ranges::sort(pairs);
    pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
  };
  for (const auto& shares : neighbourhood_.shares)
    for (const auto& s : shares)
      for (const auto& t : shares) pairs.push_back({s.crystal, t.crystal});
  sort();
  pairs = amr::all_gather<Pair>(pairs, mesh.comm());
  sort();
  const auto place = [&](int g, int h) { return static_cast<std::size_t>(std::ranges::lower_bound(pairs, Pair{g, h}) - pairs.begin()); };
  constexpr std::size_t WIDTH = std::size_t{MOST} * MOST;
  std::vector<amr::ExactSum> sums(pairs.size() * WIDTH);
  for (int b = 0; b < mesh.size(); ++b) {
    const auto& shares = neighbourhood_.shares[at(b)];
    for (std::size_t s = 0; s < shares.size(); ++s)
      for (std::size_t t = 0; t < shares.size(); ++t) {
        amr::ExactSum* sum = sums.data() + place(shares[s].crystal, shares[t].crystal) * WIDTH;
        for (int k = 0; k < count_[at(shares[s].crystal)]; ++k)
          for (int l = 0; l < count_[at(shares[t].crystal)]; ++l)
            sum[k * MOST + l].add(parts[at(b)][s * shares.size() + t][at(k)][at(l)]);
      }
  }
  const std::vector<double> all = amr::exact_sums(sums, mesh.comm());
  scale_.assign(at(size_), 0.0);
  for (std::size_t p = 0; p < pairs.size(); ++p) {
    const int g = pairs[p][0];
    for (int k = 0; k < count_[at(g)] && g == pairs[p][1]; ++k) {
      const double own = all[p * WIDTH + at(k * MOST + k)];
      if (own > 0) scale_[at(first_[at(g)] + k)] = 1 / std::sqrt(own);
    }
  }
  // Symmetric but for faces between levels. What no block holds stays at 0.
  std::vector<amr::SparseSolver::Entry> entries;
  for (std::size_t p = 0; p < pairs.size(); ++p) {
    const auto [g, h] = pairs[p];
    const std::size_t other = place(h, g);
    for (int k = 0; k < count_[at(g)]; ++k)
      for (int l = 0; l < count_[at(h)]; ++l) {
        const int row = first_[at(g)] + k, column = first_[at(h)] + l;
        const double mean = 0.5 * (all[p * WIDTH + at(k * MOST + l)] + all[other * WIDTH + at(l * MOST + k)]);
        entries.push_back({row, column, mean * scale_[at(row)] * scale_[at(column)]});
      }
  }
  for (int i = 0; i < size_; ++i)
    if (scale_[at(i)] == 0) entries.push_back({i, i, 1.0});
  inverse_ = amr::SparseSolver();  // the pattern changes
  inverse_.factorize(size_, entries);
}

// (Z^T K Z)^-1 Z^T r
std::vector<double> RigidModes::find(const amr::HierarchyField& r) const {
  const amr::Mesh& mesh = hierarchy_->mesh();
  std::vector<std::vector<Coefficients>> parts(at(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    const auto& shares = neighbourhood_.shares[at(b)];
    if (shares.empty()) return;
    const auto [g, i] = hierarchy_->place_of_block(b);
    Array<const double*> from;
    for (int a = 0; a < DIM; ++a) from[a] = r.at(g, i, a);
    thread_local std::vector<double> curl;
    curl_of(b, from, curl);
    for (const Neighbourhood::Share& share : shares) parts[at(b)].push_back(products(b, share, curl));
  });
  std::vector<amr::ExactSum> sums(at(size_));
  for (int b = 0; b < mesh.size(); ++b)
    for (std::size_t s = 0; s < parts[at(b)].size(); ++s) {
      const std::size_t crystal = at(neighbourhood_.shares[at(b)][s].crystal);
      for (int k = 0; k < count_[crystal]; ++k) sums[at(first_[crystal] + k)].add(parts[at(b)][s][at(k)]);
    }
  std::vector<double> amounts = amr::exact_sums(sums, mesh.comm());
  for (std::size_t k = 0; k < amounts.size(); ++k) amounts[k] *= scale_[k];
  inverse_.solve(amounts);
  for (std::size_t k = 0; k < amounts.size(); ++k) amounts[k] *= scale_[k];
  return amounts;
}

double RigidModes::fastest_spin(const amr::HierarchyField& r) const {
  if (empty()) return 0;
  const std::vector<double> amounts = find(r);
  double most = 0;
  for (std::size_t k = 0; k < count_.size(); ++k)
    for (int turn = 0; turn < TURNS && turn < count_[k]; ++turn)
      most = std::max(most, std::abs(amounts[at(first_[k] + turn)]) * neighbourhood_.crystals[k].radius);
  return most;
}

void RigidModes::take_from(amr::HierarchyField& r, const Momentum& momentum) {
  const amr::Mesh& mesh = hierarchy_->mesh();
  amounts_ = find(r);
  amr::parallel_for(mesh.size(), [&](int b) {
    thread_local Scratch v, image;
    v.fit(mesh.layout());
    image.fit(mesh.layout());
    if (!velocity(b, [&](std::size_t crystal) { return known(crystal); }, v.write())) return;
    momentum(b, v.read(), image.write());
    add(b, -1, image.read(), r);
  });
}

// to += factor * from on a block's own faces.
void RigidModes::add(int b, double factor, const Array<const double*>& from, amr::HierarchyField& to) const {
  const amr::Layout& layout = hierarchy_->mesh().layout();
  const auto [g, i] = hierarchy_->place_of_block(b);
  for (int a = 0; a < DIM; ++a) {
    const amr::Range range = hierarchy_->unknowns(g, i, components_[at(a)], true);
    double* x = to.at(g, i, a) + layout.offset(range.lo);
    const double* y = from[a] + layout.offset(range.lo);
    amr::for_each_row(range.size, [&](const IntVec& row) {
      const std::ptrdiff_t o = layout.offset(row);
      for (int k = 0; k < range.size[0]; ++k) x[o + k] += factor * y[o + k];
    });
  }
}

void RigidModes::add_to(amr::HierarchyField& v) const {
  const amr::Mesh& mesh = hierarchy_->mesh();
  amr::parallel_for(mesh.size(), [&](int b) {
    thread_local Scratch moved;
    moved.fit(mesh.layout());
    if (velocity(b, [&](std::size_t crystal) { return known(crystal); }, moved.write())) add(b, 1, moved.read(), v);
  });
}

}  // namespace dendrift::physics

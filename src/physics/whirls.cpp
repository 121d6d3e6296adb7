#include "physics/whirls.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <map>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/motion.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

constexpr double WIDEST = 4;        // reach over the largest radius
constexpr double COMFORTABLE = 1.3;  // reach over radius where the hull need not be tight
constexpr double NARROWEST = 2;     // cells from the hull to the reach
constexpr double FAR = 1e30;

double length(const RealVec& r) {
  double square = 0;
  for (const double x : r) square += x * x;
  return std::sqrt(square);
}

struct Grid {
  std::vector<int> number;  // of each place, or -1 inside
  std::vector<RealVec> nodes;
  std::vector<std::vector<std::size_t>> near;  // of each node: itself and those next to it

  Grid() {
    constexpr int CELLS = detail::DIRECTION_CELLS;
    amr::for_each_cell({}, filled(CELLS + 1), [&](const IntVec& place) {
      const bool outside = std::ranges::any_of(place, [](int i) { return i == 0 || i == CELLS; });
      number.push_back(outside ? static_cast<int>(nodes.size()) : -1);
      if (!outside) return;
      RealVec r{};
      for (int a = 0; a < DIM; ++a) r[a] = 2.0 * place[a] / CELLS - 1;
      const double norm = length(r);
      for (double& x : r) x /= norm;
      nodes.push_back(r);
    });
    constexpr double ANGLE = 3.0 / CELLS;
    near.resize(nodes.size());
    for (std::size_t n = 0; n < nodes.size(); ++n)
      for (std::size_t m = 0; m < nodes.size(); ++m) {
        double cosine = 0;
        for (int a = 0; a < DIM; ++a) cosine += nodes[n][a] * nodes[m][a];
        if (cosine > std::cos(ANGLE)) near[n].push_back(m);
      }
  }
};

const Grid& grid_of_directions() {
  static const Grid grid;
  return grid;
}

// Of each crystal that block b has something to say of: least numbers by direction. What is there is merged over all blocks.
using Least = std::map<std::size_t, std::vector<double>>;

std::vector<double> merged(const std::vector<Least>& parts, std::size_t crystals, MPI_Comm comm) {
  const std::size_t width = Directions::nodes().size();
  std::vector<double> most(crystals * width, -FAR);
  for (const Least& part : parts)
    for (const auto& [g, values] : part)
      for (std::size_t n = 0; n < width; ++n) most[g * width + n] = std::max(most[g * width + n], -values[n]);
  most = amr::global_max(std::move(most), comm);
  for (double& x : most) x = -x;
  return most;
}

// The cell at r, of size dx, seen from the origin: each direction that it may cover learns f(distance).
template <class F>
void stamp(const RealVec& r, double dx, std::vector<double>& least, F&& f) {
  if (least.empty()) least.assign(Directions::nodes().size(), FAR);
  for (int corner = 0; corner < 1 << DIM; ++corner) {
    RealVec x = r;
    for (int a = 0; a < DIM; ++a) x[a] += (corner >> a & 1) != 0 ? 0.5 * dx : -0.5 * dx;
    const double distance = length(x);
    if (distance > 0) Directions::around(x, [&](int n, double) { least[at(n)] = std::min(least[at(n)], f(distance)); });
  }
}

// Calls f(block, centre, crystal, least) for all cells at the rim of crystals.
template <class F>
std::vector<double> seen(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals, F&& f) {
  constexpr double STIFF = -1, DEEP = 3;  // psi where the viscosity begins to differ from melt's, and where nothing is behind
  std::vector<Least> parts(at(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    amr::for_each_cell({}, filled(mesh.layout().n), [&](const IntVec& q) {
      const std::ptrdiff_t o = mesh.layout().offset(q);
      const double p = mesh.cells(psi, b)[o];
      if (p < STIFF || p > DEEP) return;
      const RealVec x = mesh.block(b).centre(q);
      f(mesh.block(b), x, crystal_of(mesh, grain, crystals, x, b, o), parts[at(b)]);
    });
  });
  return merged(parts, crystals.size(), mesh.comm());
}

// The mean over neighbours of the largest (sign 1) or least (sign -1) of theirs: smooth, and on that side of all.
void smooth(std::vector<double>& values, double sign) {
  const auto& near = grid_of_directions().near;
  std::vector<double> extreme(values.size());
  for (std::size_t n = 0; n < values.size(); ++n) {
    extreme[n] = values[n];
    for (const std::size_t m : near[n]) extreme[n] = sign * std::max(sign * extreme[n], sign * values[m]);
  }
  for (std::size_t n = 0; n < values.size(); ++n) {
    double sum = 0;
    for (const std::size_t m : near[n]) sum += extreme[m];
    values[n] = sum / static_cast<double>(near[n].size());
  }
}

// To the walls, or half of a periodic length.
double way_out(const amr::MeshShape& shape, const RealVec& from, const RealVec& direction) {
  const RealVec hi = shape.hi();
  const Array<bool> periodic = shape.periodic();
  double least = FAR;
  for (int a = 0; a < DIM; ++a) {
    if (direction[a] == 0) continue;
    const double width = periodic[a] ? 0.5 * (hi[a] - shape.lo[a]) : direction[a] > 0 ? hi[a] - from[a] : from[a] - shape.lo[a];
    least = std::min(least, width / std::abs(direction[a]));
  }
  return least;
}

// The least number of each crystal's group; links[g * count + k]: g and k belong together. Fixed are those linked to one.
std::vector<int> groups(const std::vector<double>& links, const std::vector<bool>& fixed) {
  const std::size_t count = fixed.size();
  std::vector<int> group(count);
  for (std::size_t g = 0; g < count; ++g) group[g] = fixed[g] ? Neighbourhood::FIXED : static_cast<int>(g);
  for (bool changed = true; changed;) {
    changed = false;
    for (std::size_t g = 0; g < count; ++g)
      for (std::size_t k = 0; k < count; ++k) {
        if (links[g * count + k] == 0 || group[g] == group[k]) continue;
        group[g] = group[k] = std::min(group[g], group[k]);
        changed = true;
      }
  }
  return group;
}

// To the plane half way to another crystal, a distance D away, whose farthest solid is not this one's.
double half_way(const RealVec& to_other, double own, double others, const RealVec& direction) {
  const double distance = length(to_other);
  double cosine = 0;
  for (int a = 0; a < DIM; ++a) cosine += to_other[a] * direction[a] / distance;
  return cosine > 0 ? 0.5 * (distance + own - others) / cosine : FAR;
}

}  // namespace

namespace detail {
int direction_node(const IntVec& place) {
  int n = 0;
  for (int a = DIM - 1; a >= 0; --a) n = n * (DIRECTION_CELLS + 1) + place[a];
  return grid_of_directions().number[at(n)];
}
}  // namespace detail

const std::vector<RealVec>& Directions::nodes() { return grid_of_directions().nodes; }

double Directions::value(const std::vector<double>& at_nodes, const RealVec& r) {
  double sum = 0;
  around(r, [&](int n, double weight) { sum += weight * at_nodes[at(n)]; });
  return sum;
}

Whirl Whirl::round(const RealVec& centre, double radius, double reach) {
  const std::size_t n = Directions::nodes().size();
  return {centre, std::vector<double>(n, radius), std::vector<double>(n, reach)};
}

Neighbourhood find_neighbourhood(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals) {
  if (crystals.empty()) return {};
  const amr::MeshShape& shape = mesh.shape();
  const std::size_t width = Directions::nodes().size();
  const std::vector<double> inside = seen(mesh, psi, grain, crystals, [&](const amr::Block& block, const RealVec& x, std::size_t g, Least& least) {
    stamp(shape.way(crystals[g].position, x), block.dx, least[g], [&](double distance) { return -(distance + 0.5 * block.dx); });
  });
  std::vector<Whirl> all(crystals.size());
  std::vector<double> largest(crystals.size());
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    all[g] = Whirl::round(crystals[g].position, 0, 0);
    for (std::size_t n = 0; n < width; ++n) all[g].radius[n] = std::max(0.0, -inside[g * width + n]);
    largest[g] = *std::ranges::max_element(all[g].radius);
  }
  // Where a hull, which lies a cell or so outside its solid, holds some of another crystal, both are one.
  std::vector<std::atomic<char>> touching(crystals.size() * crystals.size());
  const std::vector<double> others = seen(mesh, psi, grain, crystals, [&](const amr::Block& block, const RealVec& x, std::size_t own, Least& least) {
    for (std::size_t g = 0; g < crystals.size(); ++g) {
      if (g == own || largest[g] == 0) continue;
      const RealVec r = shape.way(crystals[g].position, x);
      const double distance = length(r);
      if (distance < 2 * WIDEST * largest[g]) stamp(r, block.dx, least[g], [](double d) { return d; });
      const bool near = distance > 0 && distance < largest[g];
      if (near && distance < Directions::value(all[g].radius, r)) touching[g * crystals.size() + own] = 1;
    }
  });
  std::vector<double> links(touching.begin(), touching.end());
  links = amr::global_max(std::move(links), mesh.comm());
  std::vector<bool> fixed(crystals.size(), false);
  for (std::size_t g = 0; g < crystals.size(); ++g)
    for (std::size_t n = 0; n < width && largest[g] > 0; ++n)
      if (all[g].radius[n] > way_out(shape, crystals[g].position, Directions::nodes()[n])) fixed[g] = true;
  Neighbourhood found;
  found.body = groups(links, fixed);
  const double gap = NARROWEST * shape.dx(shape.max_level);
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    if (largest[g] == 0) continue;
    Whirl& w = all[g];
    for (std::size_t n = 0; n < width; ++n) {
      if (w.radius[n] == 0) w.radius[n] = largest[g];  // not seen: the centre is near a side, or outside
      w.reach[n] = std::min({WIDEST * largest[g], way_out(shape, w.centre, Directions::nodes()[n]),
                             0.5 * (w.radius[n] + others[g * width + n])});
      for (std::size_t k = 0; k < crystals.size(); ++k)
        if (k != g && largest[k] > 0)
          w.reach[n] = std::min(w.reach[n], half_way(shape.way(crystals[g].position, crystals[k].position), largest[g], largest[k],
                                                     Directions::nodes()[n]));
      w.radius[n] = std::max(w.radius[n], std::min(largest[g], w.reach[n] / COMFORTABLE));
    }
    smooth(w.radius, 1);
    smooth(w.reach, -1);
    for (std::size_t n = 0; n < width; ++n) w.reach[n] = std::max(w.reach[n], w.radius[n] + gap);
    found.whirls.push_back(std::move(w));
  }
  return found;
}

}  // namespace dendrift::physics

#include "physics/neighbourhood.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/motion.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

constexpr double FAR = 1e30;
constexpr double SOLID = 0;              // psi from which on a cell is a crystal's
constexpr double WIDEST = 2;             // how far melt goes along, over the radius
constexpr double FROZEN = 2, STUCK = 1;  // gap to a crystal, to a wall, below which the interfaces are one
constexpr int BRICK = DIM == 2 ? 8 : 5;  // corners along an axis that look for the nearest point together

double length(const RealVec& r) {
  double square = 0;
  for (const double x : r) square += x * x;
  return std::sqrt(square);
}

// The outermost cells of a crystal, seen from its centre.
struct Rim {
  Array<std::vector<double>> x;

  std::size_t size() const { return x[0].size(); }
  RealVec point(std::size_t i) const {
    RealVec r;
    for (int a = 0; a < DIM; ++a) r[a] = x[a][i];
    return r;
  }
  void add(const RealVec& r) {
    for (int a = 0; a < DIM; ++a) x[a].push_back(r[a]);
  }
};

struct Distances {
  double least;  // from the middle of a ball
  Rim rim;       // what may be nearest to any place in the ball
};

Distances nearest(const Rim& all, const RealVec& middle, double radius) {
  thread_local std::vector<double> distance;
  distance.assign(all.size(), 0.0);
  for (int a = 0; a < DIM; ++a)
    for (std::size_t i = 0; i < all.size(); ++i) distance[i] += (all.x[a][i] - middle[a]) * (all.x[a][i] - middle[a]);
  Distances d{FAR, {}};
  for (double& x : distance) d.least = std::min(d.least, x = std::sqrt(x));
  for (std::size_t i = 0; i < all.size(); ++i)
    if (distance[i] <= d.least + 2 * radius) d.rim.add(all.point(i));
  return d;
}

// Distances from the rim's cells at the corners, the first of which is at `lo`.
void measure(const Rim& rim, const RealVec& lo, double dx, const Corners& corners, std::vector<double>& out) {
  const int pitch = corners.pitch(), bricks = (pitch + BRICK - 1) / BRICK;
  amr::for_each_cell({}, filled(bricks), [&](const IntVec& brick) {
    IntVec first{}, size{};
    RealVec middle = lo;
    for (int a = 0; a < DIM; ++a) {
      first[a] = brick[a] * BRICK;
      size[a] = std::min(BRICK, pitch - first[a]);
      middle[a] += (first[a] + 0.5 * (size[a] - 1)) * dx;
    }
    const Rim near = nearest(rim, middle, 0.5 * (BRICK - 1) * std::sqrt(DIM) * dx).rim;
    amr::for_each_row(size, [&](const IntVec& row) {
      IntVec q = row;
      for (int a = 0; a < DIM; ++a) q[a] += first[a];
      std::array<double, BRICK> least, x;
      least.fill(FAR);
      for (int i = 0; i < BRICK; ++i) x[at(i)] = lo[0] + (q[0] + i) * dx;
      for (std::size_t p = 0; p < near.size(); ++p) {
        double square = 0;
        for (int a = 1; a < DIM; ++a) square += std::pow(lo[a] + q[a] * dx - near.x[a][p], 2);
        const double px = near.x[0][p];
#pragma omp simd
        for (std::size_t i = 0; i < BRICK; ++i) least[i] = std::min(least[i], (x[i] - px) * (x[i] - px) + square);
      }
      for (int& i : q) --i;
      for (int i = 0; i < size[0]; ++i) out[at(static_cast<int>(corners.offset(q))) + at(i)] = std::sqrt(least[at(i)]);
    });
  });
}

struct Gap {
  std::size_t from, to;
  double gap;
};

// The least number of each crystal's group, those linked by `links` being of one. Fixed are those linked to one.
std::vector<int> groups(const std::vector<Gap>& links, const std::vector<bool>& fixed) {
  std::vector<int> group;
  for (std::size_t g = 0; g < fixed.size(); ++g) group.push_back(fixed[g] ? Neighbourhood::FIXED : static_cast<int>(g));
  for (bool changed = true; changed;) {
    changed = false;
    for (const Gap& l : links) {
      if (group[l.from] == group[l.to]) continue;
      group[l.from] = group[l.to] = std::min(group[l.from], group[l.to]);
      changed = true;
    }
  }
  return group;
}

// Distance to the nearest side that nothing crosses.
double to_sides(const amr::MeshShape& shape, const RealVec& x) {
  const RealVec hi = shape.hi();
  double least = FAR;
  for (int a = 0; a < DIM; ++a)
    if (!shape.periodic()[a]) least = std::min({least, x[a] - shape.lo[a], hi[a] - x[a]});
  return least;
}

struct Finder {
  const amr::Mesh& mesh;
  amr::CellField psi, grain;
  const std::vector<Seed>& seeds;

  const amr::MeshShape& shape = mesh.shape();
  const amr::Layout& layout = mesh.layout();
  const Corners corners{layout.n};
  std::vector<Rim> rims{};
  std::vector<Neighbourhood::Crystal> crystals{};
  std::vector<double> reach{};  // how far melt goes along with each
  std::vector<std::vector<int>> owners{};  // by block: whose each cell and ghost is, -1 in melt; empty where there is only melt

  std::vector<int> find_owners(int b) const {
    std::vector<int> owner;
    amr::for_each_cell(filled(-amr::Layout::GHOSTS), filled(layout.pitch()), [&](const IntVec& q) {
      const std::ptrdiff_t o = layout.offset(q);
      if (mesh.cells(psi, b)[o] < SOLID) return;
      if (owner.empty()) owner.assign(at(static_cast<int>(layout.size())), -1);
      owner[at(static_cast<int>(o + layout.interior()))] = static_cast<int>(crystal_of(mesh, grain, seeds, mesh.block(b).centre(q), b, o));
    });
    return owner;
  }

  void find_rims() {
    struct Point {
      int crystal;
      RealVec r;
    };
    owners.resize(at(mesh.size()));
    std::vector<std::vector<Point>> parts(at(mesh.size()));
    amr::parallel_for(mesh.size(), [&](int b) {
      const std::vector<int>& owner = owners[at(b)] = find_owners(b);
      if (owner.empty()) return;
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
        const int* own = owner.data() + layout.interior() + layout.offset(q);
        bool rim = false;
        for (int a = 0; a < DIM; ++a) rim = rim || own[layout.stride(a)] != *own || own[-layout.stride(a)] != *own;
        if (*own >= 0 && rim) parts[at(b)].push_back({*own, shape.way(seeds[at(*own)].position, mesh.block(b).centre(q))});
      });
    });
    std::vector<Point> mine;
    for (const auto& part : parts) mine.insert(mine.end(), part.begin(), part.end());
    rims.resize(seeds.size());
    crystals.resize(seeds.size());
    const double half = 0.5 * shape.dx(shape.max_level);
    for (const Point& p : amr::all_gather<Point>(mine, mesh.comm())) {
      rims[at(p.crystal)].add(p.r);
      crystals[at(p.crystal)].radius = std::max(crystals[at(p.crystal)].radius, length(p.r) + half);
    }
    for (std::size_t k = 0; k < seeds.size(); ++k) {
      Neighbourhood::Crystal& crystal = crystals[k];
      crystal.centre = seeds[k].position;
      crystal.gap = FAR;
      for (std::size_t i = 0; i < rims[k].size(); ++i) {
        RealVec x = rims[k].point(i);
        for (int a = 0; a < DIM; ++a) x[a] += crystal.centre[a];
        crystal.gap = std::min(crystal.gap, to_sides(shape, x) - half);
      }
      double most = WIDEST * crystal.radius;
      for (int a = 0; a < DIM; ++a)
        if (shape.periodic()[a]) most = std::min(most, 0.5 * (shape.hi()[a] - shape.lo[a]) - crystal.radius);
      reach.push_back(std::max(most, 4 * half));
    }
  }

  // Of block b; and the least distances there between crystals.
  std::vector<Neighbourhood::Share> shares(int b, std::vector<Gap>& gaps) const {
    const amr::Block& block = mesh.block(b);
    const double dx = block.dx, half = 0.5 * (layout.n + 2) * dx;
    const RealVec middle = block.middle(layout.n);
    std::vector<Neighbourhood::Share> found;
    for (std::size_t k = 0; k < crystals.size(); ++k) {
      if (crystals[k].radius == 0) continue;
      RealVec way = shape.way(crystals[k].centre, middle);
      const double ball = half * std::sqrt(DIM);
      if (length(way) > crystals[k].radius + reach[k] + ball) continue;
      const Distances near = nearest(rims[k], way, ball);
      if (near.least > reach[k] + ball) continue;
      for (double& x : way) x -= half;
      found.push_back({static_cast<int>(k), std::vector<double>(corners.count())});
      measure(near.rim, way, dx, corners, found.back().part);
    }
    if (found.empty()) return found;
    const std::vector<int>& owner = owners[at(b)];
    const double finest = shape.dx(shape.max_level), skin = (DIM == 2 ? 0.75 : 0.9) * finest;  // from centres of cells to their corners
    std::vector<std::vector<double>> gap(found.size(), std::vector<double>(seeds.size(), FAR));
    amr::for_each_cell(filled(-1), filled(corners.pitch()), [&](const IntVec& q) {
      const std::size_t o = at(static_cast<int>(corners.offset(q)));
      int inside = -1;
      for (int corner = 0; !owner.empty() && corner < 1 << DIM; ++corner) {
        IntVec c = q;
        for (int a = 0; a < DIM; ++a) c[a] -= corner >> a & 1;
        const int own = owner[at(static_cast<int>(layout.interior() + layout.offset(c)))];
        if (own >= 0 && (inside < 0 || own < inside)) inside = own;
      }
      RealVec x = block.lo;
      for (int a = 0; a < DIM; ++a) x[a] += q[a] * dx;
      const double side = to_sides(shape, x);
      double sum = 0, rest = 0;  // of all parts, and what melt at rest weighs
      for (std::size_t s = 0; s < found.size(); ++s) {
        double& part = found[s].part[o];
        const double distance = std::max(part - skin, 1e-3 * finest), most = reach[at(found[s].crystal)];
        if (inside >= 0) {
          gap[s][at(inside)] = std::min(gap[s][at(inside)], part - skin);
          part = inside == found[s].crystal ? 1 : 0;
        } else {
          part = distance < most ? std::pow(1 / distance - 1 / most, 2) : 0;
          sum += part;
          // For a disc that turns alone, 1 - (distance/L)^2 with L^2 = R^2/2 bends as Stokes flow does where it leaves the disc.
          rest += part * 2 / std::pow(crystals[at(found[s].crystal)].radius, 2);
        }
      }
      if (inside >= 0 || sum == 0) return;
      const double all = side > 0 ? sum + rest / sum + 1 / (side * side) : FAR;
      for (Neighbourhood::Share& share : found) share.part[o] /= all;
    });
    for (std::size_t s = 0; s < found.size(); ++s)
      for (std::size_t k = 0; k < seeds.size(); ++k)
        if (gap[s][k] < FAR && at(found[s].crystal) != k) gaps.push_back({at(found[s].crystal), k, gap[s][k]});
    std::erase_if(found, [](const Neighbourhood::Share& s) { return std::ranges::all_of(s.part, [](double x) { return x == 0; }); });
    return found;
  }
};

}  // namespace

Neighbourhood find_neighbourhood(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals) {
  const std::size_t count = crystals.size();
  Finder finder{mesh, psi, grain, crystals};
  finder.find_rims();
  Neighbourhood result;
  result.shares.resize(at(mesh.size()));
  std::vector<std::vector<Gap>> parts(at(mesh.size()));
  if (count > 0) amr::parallel_for(mesh.size(), [&](int b) { result.shares[at(b)] = finder.shares(b, parts[at(b)]); });
  std::vector<Gap> gaps;
  for (const auto& part : parts) gaps.insert(gaps.end(), part.begin(), part.end());
  gaps = amr::all_gather<Gap>(gaps, mesh.comm());
  std::vector<bool> fixed;
  for (const Neighbourhood::Crystal& c : finder.crystals) fixed.push_back(c.gap < STUCK);
  for (const Gap& g : gaps)
    for (const std::size_t k : {g.from, g.to}) finder.crystals[k].gap = std::min(finder.crystals[k].gap, g.gap);
  std::vector<Gap> links;
  std::ranges::copy_if(gaps, std::back_inserter(links), [](const Gap& g) { return g.gap < FROZEN; });
  result.body = groups(links, fixed);
  result.crystals = std::move(finder.crystals);
  return result;
}

}  // namespace dendrift::physics

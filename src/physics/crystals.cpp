#include "physics/crystals.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

namespace dendrift::physics {

namespace {

constexpr double NOWHERE = 1e30;
constexpr int SIDE_POINTS = 6;  // on each side of the axis, for the parabola

RealVec along(const RealVec& origin, const RealVec& direction, double s) {
  RealVec x = origin;
  for (int a = 0; a < DIM; ++a) x[a] += s * direction[a];
  return x;
}

// Evaluates psi at points, in whichever block of this rank holds them.
class Probe {
 public:
  Probe(const amr::Mesh& mesh, amr::CellField psi) : mesh_(mesh), psi_(psi) {}

  // Local block that holds the point (periodic images included), or -1; `shift` carries the point into the box.
  int locate(const RealVec& x, RealVec& shift) const {
    const amr::MeshShape& shape = mesh_.shape();
    const RealVec hi = shape.hi();
    amr::BlockIndex node;
    node.level = shape.max_level;
    const double side = shape.dx(shape.max_level) * shape.block_cells;
    shift = {};
    for (int a = 0; a < DIM; ++a) {
      const double extent = hi[a] - shape.lo[a];
      double y = x[a];
      if (shape.periodic()[a]) {
        shift[a] = -std::floor((y - shape.lo[a]) / extent) * extent;
        y += shift[a];
      }
      if (y < shape.lo[a] || y > hi[a]) return -1;
      const int count = shape.root_blocks[a] << shape.max_level;
      node.coord[a] = std::min(count - 1, static_cast<int>((y - shape.lo[a]) / side));
    }
    return mesh_.local(mesh_.tree().locate(node));
  }

  // Cubic interpolation from block b, whose ghosts reach two cells further.
  double value(int b, const RealVec& x) const {
    const amr::Block& block = mesh_.block(b);
    const amr::Layout& layout = mesh_.layout();
    IntVec cell{};
    std::array<std::array<double, 4>, DIM> w{};
    for (int a = 0; a < DIM; ++a) {
      const double y = (x[a] - block.lo[a]) / block.dx - 0.5;
      cell[a] = std::clamp(static_cast<int>(std::floor(y)), -1, layout.n - 1);
      const double t = y - cell[a];
      w[static_cast<std::size_t>(a)] = {-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2,
                                        -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6};
    }
    const double* p = mesh_.cells(psi_, b) + layout.offset(cell);
    double sum = 0;
    for (int k = 0; k < (DIM == 3 ? 4 : 1); ++k)
      for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
          const double weight = w[0][static_cast<std::size_t>(i)] * w[1][static_cast<std::size_t>(j)] *
                                (DIM == 3 ? w[DIM - 1][static_cast<std::size_t>(k)] : 1.0);
          sum += weight * p[(i - 1) + (j - 1) * layout.stride(1) + (DIM == 3 ? (k - 1) * layout.stride(2) : 0)];
        }
    return sum;
  }

  // Smallest s in [first, last] at which psi changes from solid to liquid along the ray, as far as this rank sees;
  // each interval of half a cell belongs to the block that holds its beginning.
  double first_crossing(const RealVec& origin, const RealVec& direction, double first, double last) const {
    const double h = 0.5 * mesh_.shape().dx(mesh_.shape().max_level);
    for (std::int64_t i = 0; first + static_cast<double>(i) * h < last; ++i) {
      const double s = first + static_cast<double>(i) * h;
      RealVec shift;
      const int b = locate(along(origin, direction, s), shift);
      if (b < 0) continue;
      const RealVec o = along(origin, shift, 1);
      if (!(value(b, along(o, direction, s)) > 0 && value(b, along(o, direction, s + h)) <= 0)) continue;
      double lo = s, hi = s + h;
      for (int it = 0; it < 50; ++it) {
        const double middle = 0.5 * (lo + hi);
        (value(b, along(o, direction, middle)) > 0 ? lo : hi) = middle;
      }
      return 0.5 * (lo + hi);
    }
    return NOWHERE;
  }

 private:
  const amr::Mesh& mesh_;
  amr::CellField psi_;
};

// A ray parallel to an arm, at `offset` from its axis along `side`.
struct Ray {
  std::size_t tip;
  RealVec origin;
  double offset;
  double crossing = NOWHERE;
};

std::vector<RealVec> sides_of(const RealVec& d, const Seed& crystal) {
  std::vector<RealVec> sides;
  for (const RealVec& axis : crystal.axes) {
    double dot = 0;
    for (int a = 0; a < DIM; ++a) dot += axis[a] * d[a];
    if (std::abs(dot) < 0.5) sides.push_back(axis);
  }
  return sides;
}

void reduce_min(std::vector<double>& values, MPI_Comm comm) {
  MPI_Allreduce(MPI_IN_PLACE, values.data(), static_cast<int>(values.size()), MPI_DOUBLE, MPI_MIN, comm);
}

// Least squares parabola through the crossings: position = apex - (offset - shift)^2 / (2 radius).
struct Parabola {
  double radius = 0;
  double shift = 0;
};

Parabola fitted_parabola(const std::vector<Ray>& rays, std::size_t tip) {
  // Offsets are symmetric about the axis, so the odd term separates from the even ones.
  double n = 0, x = 0, xx = 0, y = 0, xy = 0, odd = 0;
  for (const Ray& r : rays) {
    if (r.tip != tip) continue;
    if (r.crossing == NOWHERE) return {};
    const double square = r.offset * r.offset;
    n += 1;
    x += square;
    xx += square * square;
    y += r.crossing;
    xy += square * r.crossing;
    odd += r.offset * r.crossing;
  }
  const double curvature = -2 * (n * xy - x * y) / (n * xx - x * x);
  if (!(n >= 3 && curvature > 0)) return {};
  return {1 / curvature, odd / x / curvature};
}

}  // namespace

std::vector<Tip> find_tips(const amr::Mesh& mesh, amr::CellField psi, const std::vector<Seed>& crystals) {
  const Probe probe(mesh, psi);
  const RealVec hi = mesh.shape().hi();
  double reach = 0;
  for (int a = 0; a < DIM; ++a) reach += (hi[a] - mesh.shape().lo[a]) * (hi[a] - mesh.shape().lo[a]);
  reach = std::sqrt(reach);
  std::vector<Tip> tips;
  std::vector<double> lengths;
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    for (int arm = 0; arm < 2 * DIM; ++arm) {
      Tip t;
      t.grain = static_cast<int>(g);
      t.arm = arm;
      t.direction = crystals[g].axes[arm / 2];
      if (arm % 2 == 1)
        for (double& d : t.direction) d = -d;
      tips.push_back(t);
      lengths.push_back(probe.first_crossing(crystals[g].position, t.direction, 0, reach));
    }
  }
  reduce_min(lengths, mesh.comm());
  std::vector<Ray> rays;
  for (std::size_t i = 0; i < tips.size(); ++i) {
    Tip& t = tips[i];
    const Seed& crystal = crystals[static_cast<std::size_t>(t.grain)];
    if (lengths[i] == NOWHERE) continue;
    t.length = lengths[i];
    t.position = along(crystal.position, t.direction, t.length);
    for (const RealVec& side : sides_of(t.direction, crystal))
      for (int m = -SIDE_POINTS; m <= SIDE_POINTS; ++m) {
        const double offset = m * TIP_WINDOW / SIDE_POINTS;
        rays.push_back({i, along(crystal.position, side, offset), offset});
      }
  }
  std::vector<double> crossings;
  for (const Ray& r : rays) {
    const Tip& t = tips[r.tip];
    crossings.push_back(probe.first_crossing(r.origin, t.direction, std::max(0.0, t.length - 2 * TIP_WINDOW), t.length + 1));
  }
  reduce_min(crossings, mesh.comm());
  for (std::size_t i = 0; i < rays.size(); ++i) rays[i].crossing = crossings[i];
  for (std::size_t i = 0; i < tips.size(); ++i) {
    const Parabola p = fitted_parabola(rays, i);
    tips[i].radius = p.radius;
    if (DIM == 2 && tips[i].length > 0) {
      // sides_of gives the other axis; it lies counterclockwise of the arm for arms 0 and 3 (x, -y) only.
      const double turn = tips[i].arm == 0 || tips[i].arm == 3 ? 1 : -1;
      tips[i].off_axis_deg = turn * std::atan2(p.shift, tips[i].length) * 180 / M_PI;
    }
  }
  tips.erase(std::remove_if(tips.begin(), tips.end(), [](const Tip& t) { return t.length == 0; }), tips.end());
  return tips;
}

}  // namespace dendrift::physics

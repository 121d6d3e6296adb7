#include "physics/turning_modes.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

double square_of(const RealVec& r) {
  double sum = 0;
  for (const double x : r) sum += x * x;
  return sum;
}

// The stream function g of a whirl, by which the velocity about an axis is curl (g axis): within the hull -r^2/2 and a
// constant, beyond it that of a disc (sphere) turning in one at rest, of this direction's radius and reach, and what the
// constant makes too much of it fades smoothly.
class Stream {
 public:
  struct Value {
    double g = 0;
    double beyond = 0;  // distance from the reach, negative inside
    bool rigid = false;
  };

  explicit Stream(const Whirl& w) : whirl_(w) {
    // The rotation drives a flux through the gap between hull and reach, which is the same all round: narrow gaps say how much.
    double sum = 0, weights = 0;
    for (std::size_t n = 0; n < w.radius.size(); ++n) {
      const double weight = w.radius[n] / std::pow(w.reach[n] - w.radius[n], 3);
      sum += weight * (Gap(w.radius[n], w.reach[n]).stream(w.radius[n]) + 0.5 * w.radius[n] * w.radius[n]);
      weights += weight;
    }
    constant_ = sum / weights;
    least_radius_ = *std::ranges::min_element(w.radius);
    largest_reach_ = *std::ranges::max_element(w.reach);
  }

  double largest_reach() const { return largest_reach_; }

  Value at(const RealVec& r) const {
    const double square = square_of(r), distance = std::sqrt(square);
    if (distance >= largest_reach_ || distance <= least_radius_) return at(distance, square, least_radius_, largest_reach_);
    return at(distance, square, Directions::value(whirl_.radius, r), Directions::value(whirl_.reach, r));
  }

 private:
  // Rate of rotation at a distance r over that of the solid: 1, then a r^-DIM + b, then 0.
  class Gap {
   public:
    Gap(double radius, double reach) : reach_(reach) {
      const double inner = std::pow(radius, -DIM), outer = std::pow(reach, -DIM);
      a_ = 1 / (inner - outer);
      b_ = -a_ * outer;
    }
    double stream(double r) const {
      const double rest = 0.5 * b_ * (reach_ * reach_ - r * r);
      return DIM == 2 ? a_ * std::log(reach_ / r) + rest : a_ * (1 / r - 1 / reach_) + rest;
    }

   private:
    double reach_, a_, b_;
  };

  Value at(double distance, double square, double radius, double reach) const {
    Value v{0, distance - reach, distance <= radius};
    if (v.rigid) {
      v.g = constant_ - 0.5 * square;
    } else if (v.beyond < 0) {
      const Gap gap(radius, reach);
      const double t = (reach - distance) / (reach - radius);
      v.g = gap.stream(distance) + (constant_ - 0.5 * radius * radius - gap.stream(radius)) * t * t * (3 - 2 * t);
    }
    return v;
  }

  const Whirl& whirl_;
  double constant_, least_radius_, largest_reach_;
};

}  // namespace

void TurningModes::build(const amr::Hierarchy& hierarchy, const std::vector<amr::Component>& velocities,
                         const std::vector<Whirl>& whirls) {
  hierarchy_ = &hierarchy;
  const amr::Mesh& mesh = hierarchy.mesh();
  const amr::Layout& layout = mesh.layout();
  inverse_.assign(whirls.size(), {});
  turns_.assign(whirls.size(), {});
  faces_.assign(at(mesh.size()), {});
  if (whirls.empty()) return;
  const std::vector<Stream> streams(whirls.begin(), whirls.end());
  amr::parallel_for(mesh.size(), [&](int b) {
    const auto [g, i] = hierarchy.place_of_block(b);
    const amr::Block& block = mesh.block(b);
    const double dx = block.dx, margin = 2 * dx;  // K Z reaches beyond Z
    const double half = 0.5 * layout.n * dx;
    RealVec middle = block.lo;
    for (double& x : middle) x += half;
    // The edges along each axis that a velocity turns about (2D: the corners).
    struct Near {
      int whirl;
      Array<std::vector<Stream::Value>> edges;
    };
    std::vector<Near> near;
    for (std::size_t w = 0; w < whirls.size(); ++w) {
      const RealVec way = mesh.shape().way(whirls[w].centre, middle);
      double square = 0;
      for (int a = 0; a < DIM; ++a) square += std::pow(std::max(0.0, std::abs(way[a]) - half), 2);
      if (square > std::pow(streams[w].largest_reach() + margin, 2)) continue;
      near.push_back({static_cast<int>(w), {}});
      for (int k = 0; k < AXES; ++k) {
        std::vector<Stream::Value>& values = near.back().edges[at(k)];
        amr::for_each_cell({}, filled(layout.n + 1), [&](const IntVec& q) {
          RealVec r = way;
          for (int a = 0; a < DIM; ++a) r[a] += (q[a] + (DIM == 3 && a == k ? 0.5 : 0.0)) * dx - half;
          values.push_back(streams[w].at(r));
        });
      }
    }
    if (near.empty()) return;
    IntVec to{};  // the next edge along each axis
    for (int a = 0, s = 1; a < DIM; ++a, s *= layout.n + 1) to[a] = s;
    for (int axis = 0; axis < DIM; ++axis) {
      const amr::Range range = hierarchy.unknowns(g, i, velocities[at(axis)], true);
      amr::for_each_cell(range.lo, range.size, [&](const IntVec& q) {
        int edge = 0;
        for (int a = 0; a < DIM; ++a) edge += q[a] * to[a];
        double least = margin;
        Face f{layout.offset(q), axis, -1, std::pow(dx, DIM), {}, {}};
        const Near* mine = nullptr;
        for (const Near& n : near)
          for (int k = 0; k < AXES; ++k) {
            if (DIM == 3 && k == axis) continue;
            const double beyond = n.edges[at(k)][at(edge)].beyond;
            if (beyond >= least) continue;
            least = beyond;
            mine = &n;
          }
        if (mine == nullptr) return;
        f.whirl = mine->whirl;
        for (int k = 0; k < AXES; ++k) {
          const int about = DIM == 2 ? 2 : k;
          if (about == axis) continue;
          const int e = 3 - axis - about;  // along it g changes, from one edge of the face to the other
          const double sign = (axis + 1) % 3 == e ? 1 : -1;
          const Stream::Value &low = mine->edges[at(k)][at(edge)], &high = mine->edges[at(k)][at(edge + to[e])];
          double slope = (high.g - low.g) / dx;
          if (low.rigid && high.rigid)  // to the last digit where nothing may be sheared
            slope = -(mesh.shape().way(whirls[at(mine->whirl)].centre, middle)[e] + (q[e] + 0.5) * dx - half);
          f.mode[at(k)] = sign * slope;
        }
        faces_[at(b)].push_back(f);
      });
    }
  });
}

void TurningModes::write(int axis, amr::HierarchyField& v) const {
  const amr::Layout& layout = hierarchy_->mesh().layout();
  amr::parallel_for(hierarchy_->mesh().size(), [&](int b) {
    const auto [g, i] = hierarchy_->place_of_block(b);
    for (int a = 0; a < DIM; ++a) std::fill_n(v.at(g, i, a) - layout.interior(), layout.size(), 0.0);
    for (const Face& f : faces_[at(b)]) v.at(g, i, f.axis)[f.place] = f.mode[at(axis)];
  });
}

void TurningModes::take_image(int axis, const amr::HierarchyField& image) {
  amr::parallel_for(hierarchy_->mesh().size(), [&](int b) {
    const auto [g, i] = hierarchy_->place_of_block(b);
    for (Face& f : faces_[at(b)]) f.image[at(axis)] = image.at(g, i, f.axis)[f.place];
  });
}

// Sums over the faces of each whirl of what f(sums, face, grid, node) adds, `width` sums a whirl.
template <class F>
std::vector<double> TurningModes::sums(std::size_t width, F&& f) const {
  const amr::Mesh& mesh = hierarchy_->mesh();
  std::vector<std::vector<double>> parts(at(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    if (faces_[at(b)].empty()) return;
    const auto [g, i] = hierarchy_->place_of_block(b);
    std::vector<double>& part = parts[at(b)];
    part.resize(width * turns_.size());
    for (const Face& face : faces_[at(b)]) f(part.data() + at(face.whirl) * width, face, g, i);
  });
  return amr::exact_sums(parts, width * turns_.size(), mesh.comm());
}

void TurningModes::prepare() {
  constexpr std::size_t SIZE = AXES;
  const std::vector<double> all = sums(SIZE * SIZE, [](double* sum, const Face& f, int, int) {
    for (std::size_t k = 0; k < SIZE; ++k)
      for (std::size_t l = 0; l < SIZE; ++l) sum[k * SIZE + l] += f.volume * f.mode[k] * f.image[l];
  });
  for (std::size_t w = 0; w < inverse_.size(); ++w) {
    using Matrix = Eigen::Matrix<double, AXES, AXES>;
    Matrix product;
    for (int k = 0; k < AXES; ++k)
      for (int l = 0; l < AXES; ++l) product(k, l) = all[w * SIZE * SIZE + at(k) * SIZE + at(l)];
    const Matrix inverse = product.trace() > 0 ? Matrix(product.inverse()) : Matrix(Matrix::Zero());
    for (int k = 0; k < AXES; ++k)
      for (int l = 0; l < AXES; ++l) inverse_[w][at(k) * SIZE + at(l)] = inverse(k, l);
  }
}

void TurningModes::take_from(amr::HierarchyField& r) {
  constexpr std::size_t SIZE = AXES;
  const std::vector<double> products = sums(SIZE, [&](double* sum, const Face& f, int g, int i) {
    const double force = f.volume * r.at(g, i, f.axis)[f.place];
    for (std::size_t k = 0; k < SIZE; ++k) sum[k] += force * f.mode[k];
  });
  for (std::size_t w = 0; w < turns_.size(); ++w)
    for (std::size_t k = 0; k < SIZE; ++k) {
      turns_[w][k] = 0;
      for (std::size_t l = 0; l < SIZE; ++l) turns_[w][k] += inverse_[w][k * SIZE + l] * products[w * SIZE + l];
    }
  amr::parallel_for(hierarchy_->mesh().size(), [&](int b) {
    const auto [g, i] = hierarchy_->place_of_block(b);
    for (const Face& f : faces_[at(b)])
      for (std::size_t k = 0; k < SIZE; ++k) r.at(g, i, f.axis)[f.place] -= turns_[at(f.whirl)][k] * f.image[k];
  });
}

void TurningModes::add_to(amr::HierarchyField& v) const {
  amr::parallel_for(hierarchy_->mesh().size(), [&](int b) {
    const auto [g, i] = hierarchy_->place_of_block(b);
    for (const Face& f : faces_[at(b)])
      for (std::size_t k = 0; k < f.mode.size(); ++k) v.at(g, i, f.axis)[f.place] += turns_[at(f.whirl)][k] * f.mode[k];
  });
}

}  // namespace dendrift::physics

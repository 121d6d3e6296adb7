#include "physics/turning_modes.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

// Rate of rotation at a distance r over that of the solid: h = 1, then a r^-DIM + b, then 0. And g with dg/dr = -h r, 0
// at the reach, whose curl is the velocity.
class Profile {
 public:
  explicit Profile(const Whirl& w) : whirl_(w) {
    const double inner = std::pow(w.radius, -DIM), outer = std::pow(w.reach, -DIM);
    a_ = 1 / (inner - outer);
    b_ = -a_ * outer;
    at_radius_ = outside(w.radius);
  }
  double stream(double square) const {
    if (square >= whirl_.reach * whirl_.reach) return 0;
    if (square <= whirl_.radius * whirl_.radius) return at_radius_ + 0.5 * (whirl_.radius * whirl_.radius - square);
    return outside(std::sqrt(square));
  }
  bool rigid(double square) const { return square <= whirl_.radius * whirl_.radius; }

 private:
  double outside(double r) const {
    const double s = whirl_.reach, rest = 0.5 * b_ * (s * s - r * r);
    return DIM == 2 ? a_ * std::log(s / r) + rest : a_ * (1 / r - 1 / s) + rest;
  }
  Whirl whirl_;
  double a_, b_, at_radius_;
};

}  // namespace

void TurningModes::build(const amr::Hierarchy& hierarchy, const std::vector<amr::Component>& velocities,
                         const std::vector<Whirl>& whirls) {
  hierarchy_ = &hierarchy;
  const amr::Mesh& mesh = hierarchy.mesh();
  const amr::Layout& layout = mesh.layout();
  const RealVec lo = mesh.shape().lo, hi = mesh.shape().hi();
  const Array<bool> periodic = mesh.shape().periodic();
  inverse_.assign(whirls.size(), {});
  turns_.assign(whirls.size(), {});
  faces_.assign(at(mesh.size()), {});
  if (whirls.empty()) return;
  amr::parallel_for(mesh.size(), [&](int b) {
    const auto [g, i] = hierarchy.place_of_block(b);
    const amr::Block& block = mesh.block(b);
    const double dx = block.dx, half = 0.5 * layout.n * dx;
    // From the centre of a whirl, or its nearest image.
    const auto arm = [&](std::size_t w, const RealVec& x) {
      RealVec r{};
      for (int a = 0; a < DIM; ++a) {
        r[a] = x[a] - whirls[w].centre[a];
        if (periodic[a]) r[a] -= (hi[a] - lo[a]) * std::round(r[a] / (hi[a] - lo[a]));
      }
      return r;
    };
    const auto edge = [&](std::size_t w) { return whirls[w].reach + 2 * dx; };  // K Z reaches beyond Z
    std::vector<std::size_t> near;
    std::vector<Profile> profiles;
    for (std::size_t w = 0; w < whirls.size(); ++w) {
      RealVec middle{};
      for (int a = 0; a < DIM; ++a) middle[a] = block.lo[a] + half;
      double square = 0;
      for (const double r : arm(w, middle)) square += std::pow(std::max(0.0, std::abs(r) - half), 2);
      if (square > edge(w) * edge(w)) continue;
      near.push_back(w);
      profiles.emplace_back(whirls[w]);
    }
    if (near.empty()) return;
    for (int axis = 0; axis < DIM; ++axis) {
      const amr::Range range = hierarchy.unknowns(g, i, velocities[at(axis)], true);
      amr::for_each_cell(range.lo, range.size, [&](const IntVec& q) {
        RealVec x{};
        for (int a = 0; a < DIM; ++a) x[a] = block.lo[a] + (q[a] + (a == axis ? 0.0 : 0.5)) * dx;
        double least = 0;
        std::size_t mine = near.size();
        RealVec r{};
        for (std::size_t k = 0; k < near.size(); ++k) {
          const RealVec to = arm(near[k], x);
          double square = 0;
          for (const double t : to) square += t * t;
          const double beyond = std::sqrt(square) - edge(near[k]);
          if (beyond >= least) continue;
          least = beyond;
          mine = k;
          r = to;
        }
        if (mine == near.size()) return;
        Face f{layout.offset(q), axis, static_cast<int>(near[mine]), std::pow(dx, DIM), {}, {}};
        const Profile& profile = profiles[mine];
        double square = 0;
        for (const double t : r) square += t * t;
        for (int k = 0; k < AXES; ++k) {
          const int about = DIM == 2 ? 2 : k;
          if (about == axis) continue;
          const int e = 3 - axis - about;  // along it g changes, from one edge of the face to the other
          const double sign = (axis + 1) % 3 == e ? 1 : -1;
          const double low = r[at(e)] - 0.5 * dx, high = r[at(e)] + 0.5 * dx, rest = square - r[at(e)] * r[at(e)];
          const bool rigid = profile.rigid(rest + low * low) && profile.rigid(rest + high * high);
          // To the last digit where nothing may be sheared.
          const double slope =
              rigid ? -r[at(e)] : (profile.stream(rest + high * high) - profile.stream(rest + low * low)) / dx;
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

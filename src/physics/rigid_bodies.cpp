#include "physics/rigid_bodies.hpp"

#include <Eigen/Dense>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"

namespace dendrift::physics {

namespace {
std::size_t at(int i) { return static_cast<std::size_t>(i); }
}  // namespace

// The face's velocity is the product of this with a motion: e_a . (V + W x r).
RigidMotion RigidBodies::mode(const Face& f) {
  RigidMotion m{};
  m[at(f.axis)] = 1;
  if constexpr (DIM == 2) {
    m[2] = f.axis == 0 ? -f.arm[1] : f.arm[0];
  } else {
    const int b = (f.axis + 1) % 3, c = (f.axis + 2) % 3;  // (W x r)_a = W_b r_c - W_c r_b
    m[at(3 + b)] = f.arm[at(c)];
    m[at(3 + c)] = -f.arm[at(b)];
  }
  return m;
}

void RigidBodies::build(const amr::Hierarchy& hierarchy, const amr::HierarchyField& drag, const std::vector<RealVec>& centres,
                        const Owners& owners) {
  hierarchy_ = &hierarchy;
  const amr::Mesh& mesh = hierarchy.mesh();
  const amr::Layout& layout = mesh.layout();
  faces_.assign(at(mesh.size()), {});
  motions_.assign(centres.size(), {});
  if (centres.empty()) return;
  std::vector<std::vector<double>> parts(at(mesh.size()));
  constexpr std::size_t MOMENTS = std::size_t{RIGID} * RIGID;
  amr::parallel_for(mesh.size(), [&](int b) {
    const auto [g, i] = hierarchy.place_of_block(b);
    const amr::Block& block = mesh.block(b);
    const double* labels = owners.label ? owners.label(b) : nullptr;
    for (int axis = 0; axis < DIM; ++axis) {
      const double* k = drag.at(g, i, axis);
      amr::Component component = drag.component(axis);
      const amr::Range r = hierarchy.unknowns(g, i, component, true);
      amr::for_each_cell(r.lo, r.size, [&](const IntVec& q) {
        const std::ptrdiff_t place = layout.offset(q);
        if (k[place] <= 0) return;
        Face f{place, axis, 0, k[place], std::pow(block.dx, DIM), {}};
        RealVec on_face = block.centre(q);
        on_face[axis] = block.lo[axis] + q[axis] * block.dx;
        if (labels != nullptr) {
          f.body = owners.body[static_cast<std::size_t>(labels[place])];
          if (f.body == HELD) return;
          f.arm = mesh.shape().way(centres[at(f.body)], on_face);
        } else {
          double least = 1e300;
          for (std::size_t n = 0; n < centres.size(); ++n) {
            const RealVec arm = mesh.shape().way(centres[n], on_face);
            double square = 0;
            for (const double x : arm) square += x * x;
            if (square >= least) continue;
            least = square;
            f.arm = arm;
            f.body = static_cast<int>(n);
          }
        }
        faces_[at(b)].push_back(f);
        std::vector<double>& part = parts[at(b)];
        part.resize(MOMENTS * centres.size());
        const RigidMotion m = mode(f);
        for (std::size_t u = 0; u < RIGID; ++u)
          for (std::size_t v = 0; v < RIGID; ++v) part[at(f.body) * MOMENTS + u * RIGID + v] += f.drag * f.volume * m[u] * m[v];
      });
    }
  });
  const std::vector<double> sums = amr::exact_sums(parts, MOMENTS * centres.size(), mesh.comm());
  inverse_.assign(centres.size(), {});
  for (std::size_t n = 0; n < centres.size(); ++n) {
    using Matrix = Eigen::Matrix<double, RIGID, RIGID, Eigen::RowMajor>;
    const Eigen::Map<const Matrix> moments(sums.data() + n * MOMENTS);
    if (moments.trace() > 0) Eigen::Map<Matrix>(inverse_[n].data()) = moments.ldlt().solve(Matrix::Identity());
  }
}

void RigidBodies::fit(const amr::HierarchyField& v) {
  const amr::Mesh& mesh = hierarchy_->mesh();
  std::vector<std::vector<double>> parts(at(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    if (faces_[at(b)].empty()) return;
    const auto [g, i] = hierarchy_->place_of_block(b);
    std::vector<double>& part = parts[at(b)];
    part.resize(RIGID * motions_.size());
    for (const Face& f : faces_[at(b)]) {
      const double load = f.drag * f.volume * v.at(g, i, f.axis)[f.place];
      const RigidMotion m = mode(f);
      for (std::size_t u = 0; u < RIGID; ++u) part[at(f.body) * RIGID + u] += load * m[u];
    }
  });
  const std::vector<double> sums = amr::exact_sums(parts, RIGID * motions_.size(), mesh.comm());
  for (std::size_t n = 0; n < motions_.size(); ++n)
    for (std::size_t u = 0; u < RIGID; ++u) {
      motions_[n][u] = 0;
      for (std::size_t w = 0; w < RIGID; ++w) motions_[n][u] += inverse_[n][u * RIGID + w] * sums[n * RIGID + w];
    }
}

void RigidBodies::subtract(int b, amr::HierarchyField& y) const {
  const auto [g, i] = hierarchy_->place_of_block(b);
  for (const Face& f : faces_[at(b)]) {
    const RigidMotion m = mode(f);
    double rigid = 0;
    for (std::size_t u = 0; u < RIGID; ++u) rigid += m[u] * motions_[at(f.body)][u];
    y.at(g, i, f.axis)[f.place] -= f.drag * rigid;
  }
}

}  // namespace dendrift::physics

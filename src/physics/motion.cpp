#include "physics/motion.hpp"

#include <algorithm>
#include <cmath>

#include "amr/comm.hpp"
#include "amr/loops.hpp"
#include "physics/alloy_kernel.hpp"

namespace dendrift::physics {

namespace {

using Vector3 = std::array<double, 3>;

std::size_t at(int i) { return static_cast<std::size_t>(i); }

Vector3 widened(const RealVec& v) {
  Vector3 w{};
  std::copy(v.begin(), v.end(), w.begin());
  return w;
}

Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

double dot(const Vector3& a, const Vector3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// The place of some solid relative to its crystal's centre, and its velocity.
struct Sample {
  std::size_t crystal;
  double volume;  // of solid
  double weight;  // in the fit of a rigid motion
  Vector3 r, v;
};

class Solid {
 public:
  Solid(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, amr::FaceField velocity, const std::vector<Seed>& crystals)
      : mesh_(mesh), psi_(psi), grain_(grain), velocity_(velocity), crystals_(crystals) {}

  /// Sums over all solid of what add(sums of the crystal, sample) adds; `width` sums a crystal.
  template <class Add>
  std::vector<double> sums(std::size_t width, Add&& add) const {
    const amr::Layout& layout = mesh_.layout();
    std::vector<std::vector<double>> parts(at(mesh_.size()));
    amr::parallel_for(mesh_.size(), [&](int b) {
      const double* psi = mesh_.cells(psi_, b);
      const amr::Block& block = mesh_.block(b);
      const double cell = std::pow(block.dx, DIM);
      std::vector<double>& part = parts[at(b)];
      amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
        const std::ptrdiff_t o = layout.offset(q);
        const double f = 0.5 * (1 + phi_of_psi(psi[o]));
        constexpr double NEGLIGIBLE = 1e-6;
        if (f < NEGLIGIBLE) return;
        part.resize(width * crystals_.size());
        const RealVec x = block.centre(q);
        RealVec v{};
        for (int a = 0; a < DIM && velocity_.id >= 0; ++a) {
          const double* u = mesh_.faces(velocity_, a, b) + o;
          v[a] = 0.5 * (u[0] + u[layout.stride(a)]);
        }
        // The interface is sheared by the melt: a spin read off all of it would be wrong by some percent. It counts
        // only where there is no core at all.
        constexpr double CORE = 0.95, FAINT = 1e-9;
        Sample s{0, f * cell, f > CORE ? cell : FAINT * f * cell, {}, widened(v)};
        find_crystal(x, b, o, s);
        add(part.data() + s.crystal * width, s);
      });
    });
    return amr::exact_sums(parts, width * crystals_.size(), mesh_.comm());
  }

  /// Sets the crystal that the cell at x belongs to, and the way from its centre.
  void find_crystal(const RealVec& x, int b, std::ptrdiff_t cell, Sample& s) const {
    s.crystal = crystal_of(mesh_, grain_, crystals_, x, b, cell);
    s.r = widened(mesh_.shape().way(crystals_[s.crystal].position, x));
  }

 private:
  const amr::Mesh& mesh_;
  amr::CellField psi_, grain_;
  amr::FaceField velocity_;
  const std::vector<Seed>& crystals_;
};

// Solves I w = l by Cramer's rule; I = integral of r^2 - r r, as xx, yy, zz, yz, zx, xy. In 2D only zz is there.
Vector3 spin_of(const Vector3& l, const double* inertia) {
  if constexpr (DIM == 2) return {0, 0, inertia[2] > 0 ? l[2] / inertia[2] : 0.0};
  const Vector3 x{inertia[0], inertia[5], inertia[4]}, y{inertia[5], inertia[1], inertia[3]}, z{inertia[4], inertia[3], inertia[2]};
  const double determinant = dot(x, cross(y, z));
  if (determinant <= 0) return {};
  return {dot(l, cross(y, z)) / determinant, dot(x, cross(l, z)) / determinant, dot(x, cross(y, l)) / determinant};
}

}  // namespace

std::array<double, 3> moment(const RealVec& r, const RealVec& f) { return cross(widened(r), widened(f)); }

std::size_t crystal_of(const amr::Mesh& mesh, amr::CellField grain, const std::vector<Seed>& crystals, const RealVec& x, int b,
                       std::ptrdiff_t cell) {
  if (grain.id >= 0) return static_cast<std::size_t>(mesh.cells(grain, b)[cell]);
  std::size_t nearest = 0;
  double least = 1e300;
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    const Vector3 r = widened(mesh.shape().way(crystals[g].position, x));
    if (dot(r, r) >= least) continue;
    least = dot(r, r);
    nearest = g;
  }
  return nearest;
}

std::vector<Load> net_loads(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, const std::vector<Seed>& crystals,
                            const std::function<const double*(int b, int axis)>& force) {
  const amr::Layout& layout = mesh.layout();
  const Solid solid(mesh, psi, grain, {}, crystals);
  constexpr std::size_t WIDTH = DIM + 3;
  std::vector<std::vector<double>> parts(at(mesh.size()));
  amr::parallel_for(mesh.size(), [&](int b) {
    const amr::Block& block = mesh.block(b);
    const double* phase = mesh.cells(psi, b);
    const double half = 0.5 * std::pow(block.dx, DIM);  // each face is met from both of its cells
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& q) {
      constexpr double MELT = -0.99;
      const std::ptrdiff_t o = layout.offset(q);
      if (phi_of_psi(phase[o]) < MELT) return;
      Sample s{};
      solid.find_crystal(block.centre(q), b, o, s);
      parts[at(b)].resize(WIDTH * crystals.size());
      double* part = parts[at(b)].data() + s.crystal * WIDTH;
      Vector3 f{};
      for (int a = 0; a < DIM; ++a) {
        const double* of_faces = force(b, a) + o;
        f[at(a)] = half * (of_faces[0] + of_faces[layout.stride(a)]);
        part[a] += f[at(a)];
      }
      // The arm across an axis is that of the cell's centre, for both of its faces.
      const Vector3 torque = cross(s.r, f);
      for (std::size_t a = 0; a < 3; ++a) part[DIM + a] += torque[a];
    });
  });
  const std::vector<double> sums = amr::exact_sums(parts, WIDTH * crystals.size(), mesh.comm());
  std::vector<Load> net(crystals.size());
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    std::copy_n(sums.data() + g * WIDTH, DIM, net[g].force.begin());
    std::copy_n(sums.data() + g * WIDTH + DIM, 3, net[g].torque.begin());
  }
  return net;
}

void measure_motion(const amr::Mesh& mesh, amr::CellField psi, amr::CellField grain, amr::FaceField velocity,
                    std::vector<Seed>& crystals) {
  if (crystals.empty()) return;
  const Solid solid(mesh, psi, grain, velocity, crystals);
  constexpr std::size_t FIRST = 8, SECOND = 9, THIRD = 2;
  const std::vector<double> first = solid.sums(FIRST, [](double* sum, const Sample& s) {
    sum[0] += s.weight;
    sum[7] += s.volume;
    for (std::size_t a = 0; a < 3; ++a) {
      sum[1 + a] += s.weight * s.r[a];
      sum[4 + a] += s.weight * s.v[a];
    }
  });
  struct Mean {
    Vector3 r{}, v{};  // centre of mass, and its velocity
  };
  std::vector<Mean> mean(crystals.size());
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    const double* sum = first.data() + g * FIRST;
    crystals[g].volume = sum[7];
    for (std::size_t a = 0; a < 3 && sum[0] > 0; ++a) {
      mean[g].r[a] = sum[1 + a] / sum[0];
      mean[g].v[a] = sum[4 + a] / sum[0];
    }
  }
  const std::vector<double> second = solid.sums(SECOND, [&](double* sum, const Sample& s) {
    Vector3 r = s.r, v = s.v;
    for (std::size_t a = 0; a < 3; ++a) {
      r[a] -= mean[s.crystal].r[a];
      v[a] -= mean[s.crystal].v[a];
    }
    const Vector3 l = cross(r, v);
    for (std::size_t a = 0; a < 3; ++a) {
      const std::size_t b = (a + 1) % 3, c = (a + 2) % 3;
      sum[a] += s.weight * l[a];
      sum[3 + a] += s.weight * (r[b] * r[b] + r[c] * r[c]);
      sum[6 + a] -= s.weight * r[b] * r[c];
    }
  });
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    const double* sum = second.data() + g * SECOND;
    crystals[g].spin = spin_of({sum[0], sum[1], sum[2]}, sum + 3);
    const Vector3 turning = cross(crystals[g].spin, mean[g].r);
    for (std::size_t a = 0; a < DIM; ++a) crystals[g].velocity[a] = mean[g].v[a] - turning[a];
  }
  const std::vector<double> third = solid.sums(THIRD, [&](double* sum, const Sample& s) {
    const Seed& crystal = crystals[s.crystal];
    const Vector3 turning = cross(crystal.spin, s.r), rigid = widened(crystal.velocity);
    for (std::size_t a = 0; a < 3; ++a) {
      const double off = s.v[a] - rigid[a] - turning[a];
      sum[0] += s.weight * off * off;
      sum[1] += s.weight * s.v[a] * s.v[a];
    }
  });
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    const double* sum = third.data() + g * THIRD;
    crystals[g].nonrigidity = sum[1] > 0 ? std::sqrt(sum[0] / sum[1]) : 0.0;
  }
}

}  // namespace dendrift::physics

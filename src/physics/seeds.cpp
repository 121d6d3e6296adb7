#include "physics/seeds.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

#include "physics/recall.hpp"

namespace dendrift::physics {

namespace {

using Matrix3 = std::array<std::array<double, 3>, 3>;

// Multiples of a right angle must give exact rows, so that a crystal along the mesh stays on the cheap path.
double exact_cos(double degrees) {
  const double turns = std::fmod(std::fmod(degrees, 360.0) + 360.0, 360.0);
  if (turns == 0) return 1;
  if (turns == 90 || turns == 270) return 0;
  if (turns == 180) return -1;
  return std::cos(degrees * std::numbers::pi / 180);
}
double exact_sin(double degrees) { return exact_cos(degrees - 90); }

Matrix3 rotation(int axis, double degrees) {
  Matrix3 m{};
  const double c = exact_cos(degrees), s = exact_sin(degrees);
  const auto i = static_cast<std::size_t>((axis + 1) % 3), j = static_cast<std::size_t>((axis + 2) % 3);
  m[static_cast<std::size_t>(axis)][static_cast<std::size_t>(axis)] = 1;
  m[i][i] = m[j][j] = c;
  m[i][j] = -s;
  m[j][i] = s;
  return m;
}

Matrix3 product(const Matrix3& a, const Matrix3& b) {
  Matrix3 m{};
  for (std::size_t i = 0; i < 3; ++i)
    for (std::size_t j = 0; j < 3; ++j)
      for (std::size_t l = 0; l < 3; ++l) m[i][j] += a[i][l] * b[l][j];
  return m;
}

// Signed, positive outside. The nearest point is (e0^2 y0/(t+e0^2), e1^2 y1/(t+e1^2)) with the largest root t of
// (e0 y0/(t+e0^2))^2 + (e1 y1/(t+e1^2))^2 = 1, which falls in t (Eberly, Distance from a point to an ellipse).
double distance_from_ellipse(std::array<double, 2> e, std::array<double, 2> y) {
  if (e[0] < e[1]) {
    std::swap(e[0], e[1]);
    std::swap(y[0], y[1]);
  }
  const auto sum = [&](double t) {
    const double a = e[0] * y[0] / (t + e[0] * e[0]), b = e[1] * y[1] / (t + e[1] * e[1]);
    return a * a + b * b - 1;
  };
  const double side = std::hypot(y[0] / e[0], y[1] / e[1]) > 1 ? 1 : -1;
  std::array<double, 2> nearest{};
  const double focal = e[0] * e[0] - e[1] * e[1];
  if (y[1] == 0 && e[0] * y[0] < focal) {  // between the centres of curvature of the long axis' ends
    const double c = e[0] * y[0] / focal;
    nearest = {e[0] * c, e[1] * std::sqrt(1 - c * c)};
  } else {
    double lo = -e[1] * e[1] + e[1] * y[1], hi = -e[1] * e[1] + std::hypot(e[0] * y[0], e[1] * y[1]);
    for (int i = 0; i < 100 && lo < hi; ++i) {
      const double t = 0.5 * (lo + hi);
      if (t <= lo || t >= hi) break;
      (sum(t) > 0 ? lo : hi) = t;
    }
    const double t = 0.5 * (lo + hi);
    for (std::size_t i = 0; i < 2; ++i) nearest[i] = y[i] == 0 ? 0 : e[i] * e[i] * y[i] / (t + e[i] * e[i]);
  }
  return side * std::hypot(nearest[0] - y[0], nearest[1] - y[1]);
}

}  // namespace

void SeedOptions::declare(io::Schema& schema, std::vector<SeedOptions>& seeds) {
  schema.list<SeedOptions>(
      "seed", "a crystal at the start: a disc (sphere) with phi = tanh((R-r)/sqrt 2) and U = -Omega; needed unless there is [flow]", seeds,
      [](io::Table& t, SeedOptions& s) {
        t.reals("position_um", s.position_um).unit("um").doc("centre, from the low corner of the box; or position_W0");
        t.reals("position_W0", s.position_w0).unit("W0").doc("centre, from the low corner of the box");
        t.real("radius_um", s.radius_um).unit("um").above(0).doc("radius at phi = 0; or radius_W0");
        t.real("radius_W0", s.radius_w0).unit("W0").above(0).doc("radius at phi = 0");
        t.real("inner_radius_um", s.inner_radius_um).unit("um").above(0).doc("of the hole of a ring (shell); or inner_radius_W0; default: no hole");
        t.real("inner_radius_W0", s.inner_radius_w0).unit("W0").above(0).doc("of the hole of a ring (shell)");
        t.real("aspect_ratio", s.aspect_ratio)
            .range(0.05, 20)
            .doc("of an ellipse (spheroid): semi-axis along crystal axis 0 over the others; radius is that of the same area (volume)");
        t.real("angle_deg", s.angle_deg).unit("degree").range(-360, 360).doc("turn about z, counterclockwise");
        t.reals("euler_deg", s.euler_deg)
            .unit("degree")
            .range(-360, 360)
            .doc("3D only: turns about z, then x, then z (Bunge), after angle_deg");
        t.real("nucleation_time_s", s.nucleation_time_s).unit("s").at_least(0).doc("when it appears, if the melt there is undercooled; default: at the start");
        t.real("nucleation_time_tau0", s.nucleation_time_tau0).unit("tau0").at_least(0).doc("the same in units of tau0");
        t.boolean("held", s.held).doc("kept in its place by a resistance; beside free crystals needs flow.solid = \"penalised\"");
      });
  schema.check({"seed"}, [&seeds](io::Checks& checks) {
    if (seeds.empty() && !checks.has_table("flow") && !checks.has_table("seeds"))
      checks.fail("seed", "at least one [[seed]], unless there is a table [seeds] or [flow]");
  });
  schema.check([&seeds](io::Checks& checks) {
    for (std::size_t i = 0; i < seeds.size(); ++i) {
      const SeedOptions& s = seeds[i];
      const std::string name = "seed[" + std::to_string(i) + "]";
      if (s.position_um.has_value() == s.position_w0.has_value())
        checks.fail(name, "exactly one of position_um and position_W0", s.position_um ? "both" : "neither");
      if (s.radius_um.has_value() == s.radius_w0.has_value())
        checks.fail(name, "exactly one of radius_um and radius_W0", s.radius_um ? "both" : "neither");
      if (s.inner_radius_um && s.inner_radius_w0)
        checks.fail(name, "at most one of inner_radius_um and inner_radius_W0", "both");
      if ((s.inner_radius_um || s.inner_radius_w0) && s.aspect_ratio != 1)
        checks.fail(name + ".aspect_ratio", "1, of a ring", fmt::format("{}", s.aspect_ratio));
      if (s.nucleation_time_s && s.nucleation_time_tau0)
        checks.fail(name, "at most one of nucleation_time_s and nucleation_time_tau0", "both");
      if (DIM == 2 && s.euler_deg != std::array<double, 3>{})
        checks.fail(name + ".euler_deg", "a scene in 3D (mesh.dim = 3); in 2D use angle_deg");
    }
  });
}

std::vector<Seed> make_seeds(const std::vector<SeedOptions>& options, const Scales& scales) {
  std::vector<Seed> seeds;
  for (const SeedOptions& o : options) {
    Seed s;
    for (int a = 0; a < DIM; ++a)
      s.position[a] = o.position_w0 ? (*o.position_w0)[a] : (*o.position_um)[a] / scales.w0_um;
    s.radius = o.radius_w0 ? *o.radius_w0 : *o.radius_um / scales.w0_um;
    s.inner_radius = o.inner_radius_w0 ? *o.inner_radius_w0 : o.inner_radius_um.value_or(0) / scales.w0_um;
    s.aspect_ratio = o.aspect_ratio;
    const Matrix3 about_z = rotation(2, o.angle_deg);
    const Matrix3 m = product(rotation(2, o.euler_deg[0]),
                              product(rotation(0, o.euler_deg[1]), product(rotation(2, o.euler_deg[2]), about_z)));
    for (int i = 0; i < DIM; ++i) {
      for (int a = 0; a < DIM; ++a) {
        s.axes[i][a] = m[static_cast<std::size_t>(a)][static_cast<std::size_t>(i)];
        if (s.axes[i][a] != (i == a ? 1.0 : 0.0)) s.rotated = true;
      }
    }
    s.angle = std::atan2(s.axes[0][1], s.axes[0][0]);
    s.nucleation_time = o.nucleation_time_tau0 ? *o.nucleation_time_tau0 : o.nucleation_time_s.value_or(0) / scales.tau0_s;
    s.present = s.nucleation_time <= 0;
    s.held = o.held;
    seeds.push_back(s);
  }
  return seeds;
}

bool several_orientations(const std::vector<Seed>& crystals, bool turning) {
  if (crystals.size() > 1 && turning) return true;
  return std::any_of(crystals.begin(), crystals.end(), [&](const Seed& s) { return s.axes != crystals.front().axes; });
}

std::array<double, 2> Seed::semi_axes() const {
  if (aspect_ratio == 1) return {radius, radius};
  const double across = radius * std::pow(aspect_ratio, -1.0 / DIM);
  return {across * aspect_ratio, across};
}

double Seed::depth(const RealVec& r) const {
  double square = 0, along = 0;
  for (int a = 0; a < DIM; ++a) {
    square += r[a] * r[a];
    along += r[a] * axes[0][a];
  }
  if (inner_radius > 0) return std::min(radius - std::sqrt(square), std::sqrt(square) - inner_radius);
  if (aspect_ratio == 1) return radius - std::sqrt(square);
  constexpr double BULK = 30;  // W0: melt, whatever the exact distance
  if (const double least = std::sqrt(square) - std::max(semi_axes()[0], semi_axes()[1]); least > BULK) return -least;
  return -distance_from_ellipse(semi_axes(), {std::abs(along), std::sqrt(std::max(0.0, square - along * along))});
}

std::vector<std::size_t> deepest(const std::vector<Seed>& crystals, const amr::MeshShape& shape, const RealVec& middle, double radius) {
  std::vector<double> depths(crystals.size(), -1e300);
  double most = -1e300;
  const auto uncertain = [&](std::size_t g) {  // of an ellipse: depth() far away is that of its circle
    const std::array<double, 2> axes = crystals[g].semi_axes();
    return radius + std::abs(axes[0] - axes[1]);
  };
  for (std::size_t g = 0; g < crystals.size(); ++g) {
    if (!crystals[g].present) continue;
    depths[g] = crystals[g].depth(shape.way(crystals[g].position, middle));
    most = std::max(most, depths[g] - uncertain(g));
  }
  std::vector<std::size_t> list;
  for (std::size_t g = 0; g < crystals.size(); ++g)
    if (crystals[g].present && depths[g] + uncertain(g) >= most) list.push_back(g);
  return list;
}

void Seed::advance(double dt) {
  for (int a = 0; a < DIM; ++a) position[a] += dt * velocity[a];
  const double rate = std::hypot(spin[0], spin[1], spin[2]);
  if (rate * dt == 0) return;
  angle += dt * spin[2];
  // Rodrigues: x cos + (n cross x) sin + n (n.x) (1 - cos)
  const double cosine = std::cos(rate * dt), sine = std::sin(rate * dt);
  for (RealVec& axis : axes) {
    std::array<double, 3> x{};
    std::copy(axis.begin(), axis.end(), x.begin());
    double along = 0;
    for (std::size_t a = 0; a < 3; ++a) along += spin[a] / rate * x[a];
    for (std::size_t a = 0; a < DIM; ++a) {
      const std::size_t b = (a + 1) % 3, c = (a + 2) % 3;
      const double cross = (spin[b] * x[c] - spin[c] * x[b]) / rate;
      axis[a] = x[a] * cosine + cross * sine + spin[a] / rate * along * (1 - cosine);
    }
  }
  // Gram-Schmidt, so that round-off does not grow over a million steps.
  for (std::size_t i = 0; i < axes.size(); ++i) {
    for (std::size_t j = 0; j < i; ++j) {
      double overlap = 0;
      for (std::size_t a = 0; a < DIM; ++a) overlap += axes[i][a] * axes[j][a];
      for (std::size_t a = 0; a < DIM; ++a) axes[i][a] -= overlap * axes[j][a];
    }
    double square = 0;
    for (const double x : axes[i]) square += x * x;
    for (double& x : axes[i]) x /= std::sqrt(square);
  }
  rotated = true;
}

void Seed::turn(double by) {
  if (by == 0) return;
  Seed turning = *this;
  turning.velocity = {};
  turning.spin = {0, 0, by};
  turning.advance(1);
  axes = turning.axes;
  angle = turning.angle;
  rotated = turning.rotated;
}

std::array<double, 4> quaternion(const Seed& crystal) {
  // Columns of the rotation matrix are the crystal's axes. Shepperd's method: divide by the largest component.
  Matrix3 m{};
  for (std::size_t i = 0; i < 3; ++i)
    for (std::size_t a = 0; a < 3; ++a)
      m[a][i] = i < DIM && a < DIM ? crystal.axes[i % DIM][a % DIM] : (i == a ? 1.0 : 0.0);
  const double trace = m[0][0] + m[1][1] + m[2][2];
  const std::array<double, 4> squares{1 + trace, 1 + 2 * m[0][0] - trace, 1 + 2 * m[1][1] - trace, 1 + 2 * m[2][2] - trace};
  const std::array<std::array<double, 4>, 4> products{{
      {squares[0], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]},
      {m[2][1] - m[1][2], squares[1], m[1][0] + m[0][1], m[0][2] + m[2][0]},
      {m[0][2] - m[2][0], m[1][0] + m[0][1], squares[2], m[2][1] + m[1][2]},
      {m[1][0] - m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2], squares[3]},
  }};
  const auto largest = static_cast<std::size_t>(std::max_element(squares.begin(), squares.end()) - squares.begin());
  std::array<double, 4> q = products[largest];
  double norm = 0;
  for (const double x : q) norm += x * x;
  const double scale = (q[0] < 0 ? -1.0 : 1.0) / std::sqrt(norm);
  for (double& x : q) x *= scale;
  return q;
}

std::vector<double> memory(const Seed& c) {
  std::vector<double> m(c.position.begin(), c.position.end());
  m.insert(m.end(), c.velocity.begin(), c.velocity.end());
  m.insert(m.end(), c.spin.begin(), c.spin.end());
  for (const RealVec& axis : c.axes) m.insert(m.end(), axis.begin(), axis.end());
  for (const bool b : {c.rotated, c.touching, c.present, c.refused}) m.push_back(b ? 1.0 : 0.0);
  m.insert(m.end(), {static_cast<double>(c.contacts), c.angle, c.volume, c.nonrigidity});
  return m;
}

void recall(Seed& c, std::span<const double> m) {
  if (m.size() != memory(c).size()) throw std::out_of_range("crystal: a list of another length");
  auto next = m.begin();
  const auto take = [&](auto& list) {
    for (double& x : list) x = *next++;
  };
  take(c.position);
  take(c.velocity);
  take(c.spin);
  for (RealVec& axis : c.axes) take(axis);
  for (bool* b : {&c.rotated, &c.touching, &c.present, &c.refused}) *b = *next++ != 0;
  c.contacts = remembered_count(m, static_cast<std::size_t>(next++ - m.begin()));
  c.angle = *next++;
  c.volume = *next++;
  c.nonrigidity = *next++;
}

}  // namespace dendrift::physics

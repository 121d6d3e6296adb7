#include "physics/seeds.hpp"

#include <cmath>
#include <numbers>

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

}  // namespace

void SeedOptions::declare(io::Schema& schema, std::vector<SeedOptions>& seeds) {
  schema.list<SeedOptions>(
      "seed", "a crystal at the start: a disc (sphere) with phi = tanh((R-r)/sqrt 2) and U = -Omega", seeds,
      [](io::Table& t, SeedOptions& s) {
        t.reals("position_um", s.position_um).unit("um").doc("centre, from the low corner of the box; or position_W0");
        t.reals("position_W0", s.position_w0).unit("W0").doc("centre, from the low corner of the box");
        t.real("radius_um", s.radius_um).unit("um").above(0).doc("radius at phi = 0; or radius_W0");
        t.real("radius_W0", s.radius_w0).unit("W0").above(0).doc("radius at phi = 0");
        t.real("angle_deg", s.angle_deg).unit("degree").range(-360, 360).doc("turn about z, counterclockwise");
        t.reals("euler_deg", s.euler_deg)
            .unit("degree")
            .range(-360, 360)
            .doc("3D only: turns about z, then x, then z (Bunge), after angle_deg");
      },
      io::Schema::Presence::required);
  schema.check([&seeds](io::Checks& checks) {
    for (std::size_t i = 0; i < seeds.size(); ++i) {
      const SeedOptions& s = seeds[i];
      const std::string name = "seed[" + std::to_string(i) + "]";
      if (s.position_um.has_value() == s.position_w0.has_value())
        checks.fail(name, "exactly one of position_um and position_W0", s.position_um ? "both" : "neither");
      if (s.radius_um.has_value() == s.radius_w0.has_value())
        checks.fail(name, "exactly one of radius_um and radius_W0", s.radius_um ? "both" : "neither");
      if (DIM == 2 && s.euler_deg != std::array<double, 3>{})
        checks.fail(name + ".euler_deg", "a scene in 3D (mesh.dim = 3); in 2D use angle_deg");
      if (s.angle_deg != seeds[0].angle_deg || s.euler_deg != seeds[0].euler_deg)
        checks.fail(name + (s.angle_deg != seeds[0].angle_deg ? ".angle_deg" : ".euler_deg"),
                    "the orientation of the first seed: crystals of several orientations are not supported yet");
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
    const Matrix3 about_z = rotation(2, o.angle_deg);
    const Matrix3 m = product(rotation(2, o.euler_deg[0]),
                              product(rotation(0, o.euler_deg[1]), product(rotation(2, o.euler_deg[2]), about_z)));
    for (int i = 0; i < DIM; ++i) {
      for (int a = 0; a < DIM; ++a) {
        s.axes[i][a] = m[static_cast<std::size_t>(a)][static_cast<std::size_t>(i)];
        if (s.axes[i][a] != (i == a ? 1.0 : 0.0)) s.rotated = true;
      }
    }
    seeds.push_back(s);
  }
  return seeds;
}

}  // namespace dendrift::physics

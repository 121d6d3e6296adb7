#include "physics/local_axes.hpp"

#include <algorithm>
#include <cmath>

#include "amr/loops.hpp"
#include "amr/transfer.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

bool uniform(const double* values, const amr::Layout& layout) {
  const double* p = values - layout.interior();
  return std::all_of(p, p + layout.size(), [&](double x) { return x == *p; });
}

// Row i: crystal axis i, for a given turn in the plane.
Array<RealVec> axes_of(double angle) {
  Array<RealVec> axes{};
  axes[0][0] = axes[1][1] = std::cos(angle);
  axes[0][1] = std::sin(angle);
  axes[1][0] = -axes[0][1];
  return axes;
}

}  // namespace

void LocalAxes::attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) {
  mesh_ = &mesh;
  ghosts_ = &ghosts;
  alpha_.id = mesh.fields().find("alpha").value_or(-1);
  grain_.id = mesh.fields().find("grain").value_or(-1);
}

void LocalAxes::update(const std::vector<Seed>& crystals) {
  if (!active()) return;
  ghosts_->fill({alpha_.id >= 0 ? alpha_ : grain_});
  blocks_.resize(at(mesh_->size()));
  amr::parallel_for(mesh_->size(), [&](int b) { prepare(b, crystals, blocks_[at(b)]); });
}

void LocalAxes::prepare(int b, const std::vector<Seed>& crystals, Own& own) const {
  const amr::Layout& layout = mesh_->layout();
  const double* grain = mesh_->cells(grain_, b);
  const double* alpha = alpha_.id >= 0 ? mesh_->cells(alpha_, b) : nullptr;
  const auto crystal = [&](std::ptrdiff_t q) -> const Seed& { return crystals[static_cast<std::size_t>(grain[q])]; };
  own.arrays.clear();
  if (uniform(alpha != nullptr ? alpha : grain, layout)) {
    // A crystal whose angle it is gives its axes, which may be those of the mesh exactly.
    own.axes = alpha == nullptr || *alpha == crystal(0).angle ? crystal(0).axes : axes_of(*alpha);
    own.rotated = false;
    for (int i = 0; i < DIM; ++i)
      for (int a = 0; a < DIM; ++a) own.rotated = own.rotated || own.axes[i][a] != (i == a ? 1.0 : 0.0);
    return;
  }
  own.arrays.assign(static_cast<std::size_t>((DIM * DIM + 1) * layout.size()), 0.0);
  double* first = own.arrays.data() + layout.interior();
  amr::for_each_cell(filled(-1), filled(layout.n + 2), [&](const IntVec& cell) {
    const std::ptrdiff_t q = layout.offset(cell);
    const Array<RealVec> axes = alpha == nullptr ? crystal(q).axes : axes_of(alpha[q]);
    for (int i = 0; i < DIM; ++i)
      for (int a = 0; a < DIM; ++a) first[(i * DIM + a) * layout.size() + q] = axes[i][a];
  });
  if (alpha != nullptr) set_disorder(alpha, mesh_->block(b).dx, first + DIM * DIM * layout.size());
}

// Mean over the faces of a cell of s |grad alpha| + e^2/2 |grad alpha|^2: the disorder at the faces is what the equation
// of alpha lets relax.
void LocalAxes::set_disorder(const double* alpha, double dx, double* disorder) const {
  const amr::Layout& layout = mesh_->layout();
  const auto difference = [&](std::ptrdiff_t q, std::ptrdiff_t s) { return amr::wrapped(alpha[q + s] - alpha[q], RIGHT_ANGLE); };
  const auto at_face = [&](std::ptrdiff_t q, int axis) {  // the high one of q
    const std::ptrdiff_t s = layout.stride(axis);
    const double normal = difference(q, s) / dx;
    double square = normal * normal;
    for (int a = 0; a < DIM; ++a) {
      if (a == axis) continue;
      const std::ptrdiff_t t = layout.stride(a);
      const double along = (difference(q - t, t) + difference(q, t) + difference(q + s - t, t) + difference(q + s, t)) / (4 * dx);
      square += along * along;
    }
    constexpr double gamma = Disorder::gamma;
    return Disorder::s * (std::sqrt(square + gamma * gamma) - gamma) + 0.5 * Disorder::e * Disorder::e * square;
  };
  amr::for_each_cell(filled(-1), filled(layout.n + 2), [&](const IntVec& cell) {
    const std::ptrdiff_t q = layout.offset(cell);
    double sum = 0;
    for (int a = 0; a < DIM; ++a) sum += at_face(q - layout.stride(a), a) + at_face(q, a);
    constexpr double NEGLIGIBLE = 1e-5;  // lowers phi by half of that
    disorder[q] = sum / FACES > NEGLIGIBLE ? sum / FACES : 0.0;
  });
}

void LocalAxes::apply(int b, AlloyBlock& block, AlloyParameters& parameters) const {
  if (!active()) return;
  const Own& own = blocks_[at(b)];
  if (own.arrays.empty()) {
    parameters.axes = own.axes;
    parameters.rotated = own.rotated;
    return;
  }
  const amr::Layout& layout = mesh_->layout();
  const double* first = own.arrays.data() + layout.interior();
  for (int i = 0; i < DIM; ++i)
    for (int a = 0; a < DIM; ++a) block.axes[i][a] = first + (i * DIM + a) * layout.size();
  block.disorder = first + DIM * DIM * layout.size();
}

}  // namespace dendrift::physics

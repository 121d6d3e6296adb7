#include "physics/local_axes.hpp"

#include <algorithm>
#include <cmath>

#include "amr/loops.hpp"
#include "amr/transfer.hpp"

namespace dendrift::physics {

namespace {

std::size_t at(int i) { return static_cast<std::size_t>(i); }

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
  own.disordered = false;
  if (amr::uniform(alpha != nullptr ? alpha : grain, layout)) {
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
  if (alpha == nullptr) return;
  double* disorder = first + DIM * DIM * layout.size();
  set_disorder(alpha, mesh_->block(b).dx, disorder);
  amr::for_each_cell({}, filled(layout.n), [&](const IntVec& cell) {
    own.disordered = own.disordered || disorder[layout.offset(cell)] > 0;
  });
}

// Mean of s |grad alpha| + e^2/2 |grad alpha|^2 over the faces of a cell: the disorder at the faces is what the equation
// of alpha lets relax. Loops cover contiguous memory, from the first to the last place needed.
void LocalAxes::set_disorder(const double* alpha, double dx, double* disorder) const {
  const amr::Layout& layout = mesh_->layout();
  const auto size = static_cast<std::size_t>(layout.size());
  thread_local std::vector<double> scratch;
  scratch.resize((DIM + 1) * size);
  Array<double*> step{};  // from a cell to the next one along an axis
  for (int a = 0; a < DIM; ++a) step[a] = scratch.data() + at(a) * size + layout.interior();
  double* face = scratch.data() + DIM * size + layout.interior();  // the high one of a cell
  const double over = 1 / dx;
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = layout.stride(a), first = -layout.interior(), last = layout.size() - layout.interior() - s;
    double* to = step[a];
#pragma omp simd
    for (std::ptrdiff_t q = first; q < last; ++q) to[q] = over * amr::wrapped(alpha[q + s] - alpha[q], RIGHT_ANGLE);
  }
  for (int a = 0; a < DIM; ++a) {
    const std::ptrdiff_t s = layout.stride(a);
    IntVec lo = filled(-1);
    lo[a] = -2;
    const std::ptrdiff_t first = layout.offset(lo), last = layout.offset(filled(layout.n));
    for (std::ptrdiff_t q = first; q <= last; ++q) face[q] = step[a][q] * step[a][q];
    for (int c = 0; c < DIM; ++c) {
      if (c == a) continue;
      const std::ptrdiff_t t = layout.stride(c);
      const double* along = step[c];
#pragma omp simd
      for (std::ptrdiff_t q = first; q <= last; ++q) {
        const double mean = 0.25 * ((along[q - t] + along[q]) + (along[q + s - t] + along[q + s]));
        face[q] += mean * mean;
      }
    }
    constexpr double gamma = Disorder::gamma, square = 0.5 * Disorder::e * Disorder::e;
#pragma omp simd
    for (std::ptrdiff_t q = first; q <= last; ++q)
      face[q] = Disorder::s * (std::sqrt(face[q] + gamma * gamma) - gamma) + square * face[q];
    for (std::ptrdiff_t q = layout.offset(filled(-1)); q <= last; ++q) disorder[q] += (face[q - s] + face[q]) / FACES;
  }
  constexpr double NEGLIGIBLE = 1e-5;  // lowers phi by half of that
  for (std::ptrdiff_t q = layout.offset(filled(-1)); q <= layout.offset(filled(layout.n)); ++q)
    if (disorder[q] < NEGLIGIBLE) disorder[q] = 0;
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

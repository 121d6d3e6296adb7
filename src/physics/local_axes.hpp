/// \file
/// The crystal axes that the phase equation finds in each cell, where crystals have several orientations.
#pragma once

#include <numbers>
#include <vector>

#include "amr/ghost.hpp"
#include "amr/mesh.hpp"
#include "physics/alloy_kernel.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// Four-fold crystals: angles are equal modulo a right angle.
inline constexpr double RIGHT_ANGLE = std::numbers::pi / 2;

/// Energy of disorder, g s |grad alpha| + h e^2/2 |grad alpha|^2 with g = h = [(1+phi)/2]^2; eqs. (1) and (4).
struct Disorder {
  static constexpr double s = 1 / 1.06, e = 1 / 1.875;
  static constexpr double gamma = 1e-4;  ///< |grad alpha| counts from here on
};

/// Prepared once a step from the cell fields "alpha" (2D) and "grain" (3D, where each cell has the axes of its grain).
/// A block in which all cells have one orientation, ghosts included, stays on the kernel's path for constant axes.
/// Without these fields there is nothing to do, and all blocks have the axes of the first crystal.
class LocalAxes {
 public:
  void attach(amr::Mesh& mesh, amr::GhostExchange& ghosts);
  bool active() const { return grain_.id >= 0; }
  /// Collective; fills the ghosts of the field that decides.
  void update(const std::vector<Seed>& crystals);
  /// Whether a boundary of grains may form in block b, even if it is all solid.
  bool disordered(int b) const { return active() && blocks_[static_cast<std::size_t>(b)].disordered; }
  /// Hands the kernel what block b has of its own.
  void apply(int b, AlloyBlock& block, AlloyParameters& parameters) const;

 private:
  struct Own {
    Array<RealVec> axes{};
    bool rotated = false, disordered = false;
    std::vector<double> arrays;  // axes cell by cell, then the disorder; empty: axes are the same everywhere
  };
  void prepare(int b, const std::vector<Seed>& crystals, Own& own) const;
  void set_disorder(const double* alpha, double dx, double* disorder) const;

  amr::CellField alpha_, grain_;  // id -1: not there
  amr::Mesh* mesh_ = nullptr;
  amr::GhostExchange* ghosts_ = nullptr;
  std::vector<Own> blocks_;
};

}  // namespace dendrift::physics

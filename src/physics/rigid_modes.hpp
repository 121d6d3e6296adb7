/// \file
/// Rigid motions of crystals with the melt between them, which multigrid does not see: a second level of the preconditioner.
#pragma once

#include <functional>
#include <vector>

#include "amr/hierarchy.hpp"
#include "amr/sparse_solver.hpp"
#include "physics/neighbourhood.hpp"

namespace dendrift::physics {

/// Velocities Z = curl(part * potential), free of divergence; the part is a crystal's share of the melt (Neighbourhood), the
/// potential that of a rigid motion, so that crystals move rigidly and melt in a film follows the crystals on its sides. In 2D
/// one more, the constant potential: melt flowing round a crystal at rest, without which crystals that slide along each other
/// would push it through their film. A crystal with melt around it only turns (translations multigrid finds by itself).
/// With K the momentum operator, what forces r move is Z c, c = (Z^T K Z)^-1 Z^T r.
class RigidModes {
 public:
  /// K v on the faces of local block b, of v on the block and one layer of ghosts; arrays as the mesh's, from cell (0,0[,0]).
  using Momentum = std::function<void(int b, const Array<const double*>& v, const Array<double*>& out)>;

  /// `velocities`: the first components of all fields that are handed over later.
  void build(const amr::Hierarchy& hierarchy, const std::vector<amr::Component>& velocities, Neighbourhood neighbourhood);
  bool empty() const { return size_ == 0; }
  /// After build and whenever K has changed. Collective.
  void prepare(const Momentum& momentum);

  /// The largest speed of a crystal's farthest point in Z c of forces r, of rotations alone. Collective, the same on any ranks.
  double fastest_spin(const amr::HierarchyField& r) const;
  /// r -= K Z c. Collective, the same on any ranks.
  void take_from(amr::HierarchyField& r, const Momentum& momentum);
  /// v += Z c, c of the last take_from.
  void add_to(amr::HierarchyField& v) const;

 private:
  static constexpr int TURNS = DIM == 2 ? 1 : 3;                // also the components of the potential
  static constexpr int MOST = TURNS + DIM + (DIM == 2 ? 1 : 0);  // modes of a crystal
  using Coefficients = std::array<double, MOST>;
  /// constant + linear . r + square r^2/2, r from the crystal's centre
  struct Polynomial {
    double constant = 0, square = 0;
    RealVec linear{};
  };

  std::array<Polynomial, TURNS> potential(std::size_t crystal, const Coefficients& c) const;
  RealVec first_corner(int b, std::size_t crystal) const;
  void add(int b, double factor, const Array<const double*>& from, amr::HierarchyField& to) const;
  template <class C>
  bool velocity(int b, C&& coefficients, const Array<double*>& v) const;
  void curl_of(int b, const Array<const double*>& r, std::vector<double>& curl) const;
  Coefficients products(int b, const Neighbourhood::Share& share, const std::vector<double>& curl) const;
  Coefficients known(std::size_t crystal) const;
  std::vector<double> find(const amr::HierarchyField& r) const;

  const amr::Hierarchy* hierarchy_ = nullptr;
  std::vector<amr::Component> components_;
  Neighbourhood neighbourhood_;
  std::vector<int> first_, count_;  // modes of each crystal
  int size_ = 0;
  std::vector<double> scale_, amounts_;
  amr::SparseSolver inverse_;
};

}  // namespace dendrift::physics

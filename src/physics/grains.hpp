/// \file
/// Which solid is whose, in scenes of several crystals: labels that ride with them, contact, and later seeds.
#pragma once

#include <memory>
#include <vector>

#include "physics/module.hpp"
#include "physics/phase_field.hpp"
#include "physics/recall.hpp"
#include "physics/scales.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// Provides the cell field "grain": the number of the crystal that a cell belongs to, or in melt that of the crystal it is
/// nearest to. Reads psi, c and, if there is one, the velocity.
///
/// A cell of solid holds a marker: a label, and how far from the cell's centre the marker has got. Markers move with the
/// velocity; once one has moved by a part of a cell, each cell takes the nearest of those around it. A boundary between two
/// crystals thus follows them to within half a cell for good, however slow they are. In melt a cell copies the label of that
/// neighbour which has the largest psi, so that labels are there before the front is.
class Grains : public Module {
 public:
  Grains(const Scales& scales, const PhaseFieldOptions& phase, std::vector<Seed>& crystals);
  const char* name() const override { return "grains"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) override;
  void initialize() override;
  void advance(double t, double dt, std::int64_t step) override;
  void before_tagging() override;
  void tag(int b, amr::Tag& tag) const override;
  std::vector<double> memory() const override { return {static_cast<double>(waited_)}; }
  void recall(const std::vector<double>& m) override { waited_ = remembered_count(m, 0); }

 private:
  double move_markers(double dt);
  void assign();
  void assign_block(int b);
  void find_contacts();
  void nucleate(double t);
  bool undercooled(const Seed& seed) const;
  void draw(std::size_t number);
  RealVec from_centre(const Seed& seed, const amr::Block& block, const IntVec& cell) const;
  template <class F>
  void near_seed(const Seed& seed, double reach, F&& f) const;

  Scales scales_;
  PhaseFieldOptions phase_;
  std::vector<Seed>& crystals_;
  amr::CellField psi_, c_, grain_, grain_next_;
  Array<amr::CellField> shift_{}, shift_next_{};  // of the marker, W0
  amr::FaceField v_;  // id -1: nothing moves
  amr::Mesh* mesh_ = nullptr;
  amr::GhostExchange* ghosts_ = nullptr;
  int waited_ = 0;  // steps since cells last took markers
};

}  // namespace dendrift::physics

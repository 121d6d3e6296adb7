/// \file
/// The orientation of many crystals: table [orientation]; eq. (4). Active where crystals have, or may get, several.
#pragma once

#include <memory>

#include "amr/scalar_solver.hpp"
#include "io/config.hpp"
#include "physics/module.hpp"
#include "physics/recall.hpp"
#include "physics/seeds.hpp"

namespace dendrift::physics {

/// P of eq. (4), the mobility's inverse. constant: mu/e, that of uniform orientation, everywhere; grains keep theirs.
/// warren: 1 - (1 - mu/e) exp(-beta w), which falls to 1 in boundaries: these sweep whole grains within a few tau0.
/// printed: 1 - (1 + mu/e) exp(-beta w), negative at w = 0, so that disturbances grow; refused.
enum class Mobility : std::uint8_t { constant, warren, printed };

struct OrientationOptions {
  Mobility p = Mobility::constant;
  double max_dt_tau0 = 1;
  double tolerance = 1e-3;
  bool everywhere = false;

  void declare(io::Schema& schema);
};

/// P for a given w = e |grad alpha|.
double inverse_mobility(Mobility law, double w);

/// Provides the cell field "alpha" (2D): the exact angle of its grain in every cell of a grain that nothing touches,
/// and the solution of eq. (4) in grains that touch others. In 3D there is no equation: a cell has the axes of its
/// grain. The angle of a crystal that eq. (4) rules is the mean over its core. Reads psi, "grain" and, if there is one,
/// the velocity.
///
/// Eq. (4) is split: alpha is carried, turned by half the vorticity of the solid, and then relaxes by backward Euler
/// with coefficients from before, on all levels at once. All differences are taken modulo a right angle.
class Orientation : public Module {
 public:
  Orientation(const OrientationOptions& options, std::vector<Seed>& crystals);
  const char* name() const override { return "orientation"; }
  void declare(amr::FieldTable& fields) override;
  void attach(amr::Mesh& mesh, amr::GhostExchange& ghosts) override;
  void initialize() override;
  void advance(double t, double dt, std::int64_t step) override;
  void before_tagging() override;
  void tag(int b, amr::Tag& tag) const override;
  std::vector<double> memory() const override { return {elapsed_, static_cast<double>(present_)}; }
  void recall(const std::vector<double>& m) override {
    elapsed_ = m.at(0);
    present_ = remembered_count(m, 1);
  }

  int solver_iterations() const { return iterations_; }  ///< of the last solution

 private:
  void impose(const std::vector<Seed>& crystals, bool all);
  void welcome();
  void follow(const std::vector<Seed>& moved);
  void carry(double dt, bool slow);
  void carry_stage(amr::CellField from, amr::CellField to, double old_share, double dt);
  void turn(double dt);
  void extend(amr::CellField values, double least_psi, int layers, bool free_only);
  void relax(double dt);
  double sweep(double dt, bool first);
  double set_system(int b, double dt, bool first);
  double fastest_crossing() const;
  void find_busy();
  /// Whether eq. (4) holds in a crystal.
  bool free(const Seed& crystal) const { return options_.everywhere || crystal.touching; }
  bool free_cell(double grain) const { return free(crystals_[static_cast<std::size_t>(grain)]); }

  OrientationOptions options_;
  std::vector<Seed>& crystals_;
  amr::CellField psi_, grain_, alpha_, first_, second_, valid_;
  amr::FaceField v_;  // id -1: nothing moves
  amr::Mesh* mesh_ = nullptr;
  amr::GhostExchange* ghosts_ = nullptr;
  std::vector<char> busy_;  // by block: whether eq. (4) has anything to say there
  std::unique_ptr<amr::ScalarSolver> solver_;
  std::int64_t solver_generation_ = -1;
  double elapsed_ = 0;  // since alpha relaxed last
  int iterations_ = 0;
  int present_ = 0;  // crystals whose cells have had their angle
};

}  // namespace dendrift::physics

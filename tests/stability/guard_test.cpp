// Faults put into a run on purpose: it goes back, takes smaller steps and ends where it would have ended, or says why not.
#include <fmt/format.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <limits>

#include "support/scene.hpp"

namespace dendrift::test {
namespace {

namespace fs = std::filesystem;

class Guard : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::path(testing::TempDir()) / fmt::format("dendrift_guard_{}_{}", DIM, ::getpid());
    fs::remove_all(folder_);
  }
  void TearDown() override { fs::remove_all(folder_); }

  std::string text(const std::string& more = "") const {
    return corner_crystal(32, 1, "[alloy]\nsupersaturation = 0.8\n" + more) + fmt::format("[output]\ndir = \"{}\"\n", folder_.string());
  }
  static void spoil(Simulation& s, double value) {
    if (s.mesh().size() > 0) s.mesh().cells(s.field("c"), s.mesh().size() / 2)[s.mesh().layout().offset(filled(3))] = value;
  }
  static double tip(Simulation& s) { return s.tips().at(0).length; }

  fs::path folder_;
};

constexpr double END = DIM == 2 ? 12 : 9;
const std::vector<std::string> SHORT{fmt::format("run.end_time_tau0={}", END), "output.diagnostics_every_tau0=4"};

// With the same steps afterwards nothing tells that there was a failure.
TEST_F(Guard, GoesBackToExactlyTheSameState) {
  std::vector<double> c[2];
  std::map<std::int64_t, double> steps;
  for (const bool fails : {false, true}) {
    Scene scene(text(), SHORT);
    bool armed = fails;
    scene->before_step([&](double dt) {
      const std::int64_t n = scene->step_number();
      if (armed && n == 33) {
        armed = false;
        spoil(*scene.simulation, std::numeric_limits<double>::quiet_NaN());
      }
      return fails ? steps.at(n) : steps[n] = dt;
    });
    scene->run();
    EXPECT_EQ(scene->caution().failures(), fails ? 1 : 0);
    for (int b = 0; b < scene->mesh().size(); ++b)
      amr::for_each_cell({}, filled(scene->mesh().layout().n), [&](const IntVec& q) {
        c[fails ? 1 : 0].push_back(scene->mesh().cells(scene->field("c"), b)[scene->mesh().layout().offset(q)]);
      });
  }
  EXPECT_EQ(c[0], c[1]);
}

TEST_F(Guard, RecoversFromWhatIsNotFiniteOrOutOfBounds) {
  Scene sound(text(), SHORT);
  sound->run();
  for (const double value : {std::numeric_limits<double>::quiet_NaN(), 1e6, -1.0, std::numeric_limits<double>::infinity()}) {
    Scene scene(text(), SHORT);
    bool armed = true;
    scene->before_step([&](double dt) {
      if (armed && scene->time() > 7) {
        armed = false;
        spoil(*scene.simulation, value);
      }
      return dt;
    });
    EXPECT_EQ(scene->run(), Outcome::done);
    EXPECT_EQ(scene->caution().failures(), 1) << value;
    EXPECT_NEAR(tip(*scene.simulation), tip(*sound.simulation), 2e-4 * tip(*sound.simulation)) << value;
    EXPECT_LT(std::abs(scene->solute_drift(scene->totals())), 1e-12) << value;
  }
}

TEST_F(Guard, RecoversFromStepsTenTimesTooLarge) {
  const std::vector<std::string> slow{"run.end_time_tau0=40", "alloy.supersaturation=0.5", "output.diagnostics_every_tau0=20"};
  Scene sound(text(), slow);
  sound->run();
  Scene scene(text(), slow);
  scene->before_step([&](double dt) { return scene->time() > 20 && scene->time() < 30 ? 10 * dt : dt; });
  EXPECT_EQ(scene->run(), Outcome::done);
  EXPECT_GE(scene->caution().failures(), 1);
  EXPECT_NEAR(tip(*scene.simulation), tip(*sound.simulation), 5e-3 * tip(*sound.simulation));
}

TEST_F(Guard, RecoversFromASolverThatStalls) {
  constexpr double end = DIM == 2 ? 20 : 3;
  const std::string flow = "[flow]\ngravity_um_s2 = 1e8\nmax_interval_tau0 = 4\n";
  const std::vector<std::string> slow{fmt::format("run.end_time_tau0={}", end), "alloy.supersaturation=0.5",
                                      fmt::format("output.diagnostics_every_tau0={}", end / 2)};
  Scene sound(text(flow), slow);
  int most = 0;
  sound->before_step([&](double dt) {
    most = std::max(most, sound->report().flow_iterations);
    return dt;
  });
  sound->run();
  std::vector<std::string> few = slow;
  few.push_back(fmt::format("flow.max_iterations={}", most + 2));
  Scene scene(text(flow), few);
  bool armed = true;
  scene->before_step([&](double dt) {  // a first guess from which that many do not suffice
    if (armed && scene->time() > 0.6 * end) {
      armed = false;
      const amr::CellField pressure = scene->field("pressure");
      for (int b = 0; b < scene->mesh().size(); ++b)
        amr::for_each_cell({}, filled(scene->mesh().layout().n), [&](const IntVec& q) {
          scene->mesh().cells(pressure, b)[scene->mesh().layout().offset(q)] = 1e6 * std::sin(37.0 * q[0] * q[0] + 11.0 * q[1] + b);
        });
    }
    return dt;
  });
  EXPECT_EQ(scene->run(), Outcome::done);
  EXPECT_GE(scene->caution().failures(), 1);
  EXPECT_NEAR(tip(*scene.simulation), tip(*sound.simulation), 2e-3 * tip(*sound.simulation));
}

// A prescribed velocity carries solute out through the sides of the box, and other solute in.
TEST_F(Guard, SoluteThatIsCarriedThroughSidesIsNotLost) {
  Scene scene(text("[flow]\nvelocity_gradient_per_tau0 = " + std::string(DIM == 2 ? "[0, -0.05, 0.05, 0]\n" : "[0, -0.05, 0, 0.05, 0, 0, 0, 0, 0]\n")),
              SHORT);
  EXPECT_EQ(scene->run(), Outcome::done);
  EXPECT_EQ(scene->caution().failures(), 0);
  EXPECT_GT(std::abs(scene->solute_drift(scene->totals())), 1e-6);
}

TEST_F(Guard, GivesUpWithTheCauseAndLosesNothing) {
  {
    Scene scene(text(), SHORT);
    scene->before_step([&](double dt) {
      if (scene->time() > 7) spoil(*scene.simulation, std::numeric_limits<double>::quiet_NaN());
      return dt;
    });
    try {
      scene->run();
      ADD_FAILURE() << "went on";
    } catch (const NumericalError& e) {
      const std::string message = e.what();
      for (const char* part : {"phi or c is not finite at step ", "block on level", "the last good state", "nan"})
        EXPECT_NE(message.find(part), std::string::npos) << message;
    }
    EXPECT_EQ(scene->caution().failures(), 6);  // the first and five more tries
  }
  int failed = 0;
  std::string good;
  for (const auto& e : fs::directory_iterator(folder_)) {
    failed += e.path().filename().string().starts_with("failed_") ? 1 : 0;
    if (e.path().filename().string().starts_with("chk_")) good = e.path().string();
  }
  EXPECT_EQ(failed, 1);
  ASSERT_FALSE(good.empty());
  Settings settings;
  settings.parse_text(text(), "test", SHORT);
  Simulation again(settings, MPI_COMM_SELF, good);
  EXPECT_GT(again.time(), 5);
  EXPECT_EQ(again.run(), Outcome::done);
}

TEST_F(Guard, NoSnapshotsNoRetries) {
  Scene scene(text(), {SHORT[0], SHORT[1], "guard.snapshot_every_steps=0"});
  scene->before_step([&](double dt) {
    spoil(*scene.simulation, 1e6);
    return dt;
  });
  EXPECT_THROW(scene->run(), NumericalError);
  EXPECT_EQ(scene->caution().failures(), 0);
}

TEST_F(Guard, LossOfSoluteIsNoticed) {
  Scene scene(text(), SHORT);
  scene->before_step([&](double dt) {
    spoil(*scene.simulation, 0.9);  // makes sense by itself
    return dt;
  });
  try {
    scene->run();
    ADD_FAILURE() << "went on";
  } catch (const NumericalError& e) {
    EXPECT_NE(std::string(e.what()).find("solute is not conserved"), std::string::npos) << e.what();
  }
}

TEST_F(Guard, CollapseOfTheStepIsNoticed) {
  Scene scene(text("[guard]\nmin_dt_tau0 = 1\n"), SHORT);
  try {
    scene->run();
    ADD_FAILURE() << "went on";
  } catch (const NumericalError& e) {
    EXPECT_NE(std::string(e.what()).find("time step has collapsed"), std::string::npos) << e.what();
  }
}

}  // namespace
}  // namespace dendrift::test

/// \file
/// What the benchmarks share: the clock, statistics over repetitions, pairs timed in turn, and a sample state.
#pragma once

#include <benchmark/benchmark.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <vector>

#include "amr/ghost.hpp"
#include "amr/mesh.hpp"
#include "physics/alloy_kernel.hpp"
#include "plain_alloy.hpp"

namespace dendrift::bench {

/// Seconds of processor time of this process, all its threads: what other users of the machine disturb least.
inline double core_seconds() {
  std::timespec t{};
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

template <class F>
double timed(F&& f) {
  const double begin = core_seconds();
  f();
  return core_seconds() - begin;
}

/// A rate of cell updates, in millions a second and core. One update is one stage of one cell.
inline benchmark::Counter mcells(double updates_per_iteration) {
  return {1e-6 * updates_per_iteration, benchmark::Counter::kIsIterationInvariantRate};
}

inline double least(const std::vector<double>& v) { return *std::min_element(v.begin(), v.end()); }
inline double greatest(const std::vector<double>& v) { return *std::max_element(v.begin(), v.end()); }
inline double median(std::vector<double> v) {
  std::sort(v.begin(), v.end());
  const std::size_t m = v.size() / 2;
  return v.size() % 2 == 1 ? v[m] : 0.5 * (v[m - 1] + v[m]);
}

/// For rows that google/benchmark repeats: processor time, and minimum and maximum beside mean and median.
inline void repeated(benchmark::internal::Benchmark* b) {
  b->MeasureProcessCPUTime()->Unit(benchmark::kMillisecond);
  b->ComputeStatistics("min", least)->ComputeStatistics("max", greatest);
}

/// For rows made of pairs: an iteration times one pair.
inline void in_pairs(benchmark::internal::Benchmark* b) {
  b->UseManualTime()->Repetitions(1)->Iterations(21)->Unit(benchmark::kMillisecond);
}

/// The times of one side of a comparison.
struct Times {
  double updates = 0, seconds = 0;
  std::vector<double> each;  ///< seconds an update
  template <class F>
  double run(F&& f) {
    double u = 0;
    const double t = timed([&] { u = f(); });
    updates += u;
    seconds += t;
    each.push_back(t / u);
    return t;
  }
};

/// Runs `ours` and `plain` in turn, the order alternating; each returns the cell updates it did. Reports the times per
/// update as ratios of ours to plain: median, minimum and maximum over the pairs, and the ratio of the total times.
template <class Ours, class Plain>
void run_pairs(benchmark::State& state, Ours&& ours, Plain&& plain) {
  Times a, b;
  ours();
  plain();
  std::vector<double> ratios;
  for (auto _ : state) {
    const bool plain_first = ratios.size() % 2 == 1;
    if (plain_first) b.run(plain);
    state.SetIterationTime(a.run(ours));
    if (!plain_first) b.run(plain);
    ratios.push_back(a.each.back() / b.each.back());
  }
  state.counters["ratio"] = median(ratios);
  state.counters["ratio_min"] = least(ratios);
  state.counters["ratio_max"] = greatest(ratios);
  state.counters["ratio_of_totals"] = (a.seconds / a.updates) / (b.seconds / b.updates);
  state.counters["Mcell_per_s"] = 1e-6 / median(a.each);
  state.counters["plain_Mcell_per_s"] = 1e-6 / median(b.each);
}

inline constexpr int CELLS = DIM == 2 ? 512 : 64;  ///< along a side of the uniform sample state
inline constexpr double DX = DIM == 2 ? 1.0 : 0.8;

/// Al-4wt%Cu, as in inputs/verification/al_cu_free.toml.
inline physics::AlloyParameters alloy() { return {}; }
/// The second of the four stages of a step of 0.4 tau0 in 2D.
inline physics::Stage second_stage() { return {-0.5, 1.5 * 0.04}; }

/// Cell means of a lattice of crystals in a melt, 64 cells apart and 48 across: every block of 32 cells a side sees an
/// interface. Arguments count cells.
struct Sample {
  double psi, c;
  explicit Sample(const IntVec& cell) {
    double r2 = 0;
    for (int a = 0; a < DIM; ++a) {
      const double x = (cell[a] & 63) + 0.5 - 32;
      r2 += x * x;
    }
    psi = std::clamp((24 - std::sqrt(r2)) * DX, -physics::PSI_MAX, physics::PSI_MAX);
    const double u = -0.2 + 0.15 * std::exp(std::min(psi, 0.0) / 8);
    c = physics::c_of_u(u, physics::phi_of_psi(psi), alloy().k);
  }
};

/// A uniform mesh cut into blocks, as the program holds it, with the fields that the kernel needs.
class Blocks {
 public:
  Blocks(int cells, int block_cells, double dx);
  int size() const { return mesh_.size(); }
  physics::AlloyBlock arrays(int b);
  /// f(cell of the whole mesh, offset in the arrays of block b) for every interior cell of block b.
  template <class F>
  void for_each(int b, F&& f) {
    const amr::Layout& layout = mesh_.layout();
    amr::for_each_cell({}, filled(layout.n), [&](const IntVec& c) {
      IntVec cell = c;
      for (int a = 0; a < DIM; ++a) cell[a] += mesh_.block(b).index.coord[a] * layout.n;
      f(cell, layout.offset(c));
    });
  }
  double* psi(int b) { return mesh_.cells(psi_, b); }
  double* c(int b) { return mesh_.cells(c_, b); }
  void fill_ghosts() { ghosts_.fill({psi_, c_}); }
  void swap();

 private:
  static amr::MeshShape shape(int cells, int block_cells, double dx);
  amr::FieldTable fields();
  amr::CellField psi_, c_, psi_next_, c_next_;
  amr::Mesh mesh_;
  amr::GhostExchange ghosts_;
};

/// Fills psi and c, next included, from Sample, ghosts too.
void set_sample(Blocks& blocks);
void set_sample(PlainAlloy& plain);

/// Largest difference between kernel and plain loop after four stages on a small sample state.
double kernel_minus_plain(int block_cells);

}  // namespace dendrift::bench

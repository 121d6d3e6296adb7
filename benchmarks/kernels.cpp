// One stage of growth on a uniform mesh: the kernel on blocks, the plain loop, and one against the other.
#include "common.hpp"

namespace dendrift::bench {

namespace {

using physics::BlockKind;

constexpr double UPDATES = DIM == 2 ? double{CELLS} * CELLS : double{CELLS} * CELLS * CELLS;

void advance(Blocks& blocks, BlockKind kind, int n) {
  for (int b = 0; b < blocks.size(); ++b)
    physics::advance_alloy(blocks.arrays(b), kind, alloy(), second_stage(), n);
}

void kernel(benchmark::State& state, BlockKind kind) {
  const int n = static_cast<int>(state.range(0));
  Blocks blocks(CELLS, n, DX);
  set_sample(blocks);
  for (auto _ : state) advance(blocks, kind, n);
  state.counters["Mcell_per_s"] = mcells(UPDATES);
}

void plain_uniform(benchmark::State& state) {
  const int n = static_cast<int>(state.range(0));
  PlainAlloy plain(n, DX);
  set_sample(plain);
  for (auto _ : state) plain.advance(alloy(), second_stage());
  state.counters["Mcell_per_s"] = mcells(std::pow(n, DIM));
}

void paired_kernel_vs_plain(benchmark::State& state) {
  const int n = static_cast<int>(state.range(0));
  Blocks blocks(CELLS, n, DX);
  PlainAlloy plain(CELLS, DX);
  set_sample(blocks);
  set_sample(plain);
  constexpr int TIMES = 4;
  run_pairs(
      state,
      [&] {
        for (int i = 0; i < TIMES; ++i) advance(blocks, BlockKind::interface, n);
        return TIMES * UPDATES;
      },
      [&] {
        for (int i = 0; i < TIMES; ++i) plain.advance(alloy(), second_stage());
        return TIMES * UPDATES;
      });
}

void block_sizes(benchmark::internal::Benchmark* b) {
  for (const int n : {8, 16, 32})
    if (DIM == 2 || n < 32) b->Arg(n);
}

BENCHMARK_CAPTURE(kernel, interface, BlockKind::interface)->Name("kernel_interface")->Apply(block_sizes)->Apply(repeated);
BENCHMARK_CAPTURE(kernel, liquid, BlockKind::liquid)->Name("kernel_liquid")->Apply(block_sizes)->Apply(repeated);
BENCHMARK_CAPTURE(kernel, solid, BlockKind::solid)->Name("kernel_solid")->Apply(block_sizes)->Apply(repeated);
BENCHMARK(plain_uniform)->Arg(CELLS)->Arg(DIM == 2 ? 2048 : 128)->Apply(repeated);
BENCHMARK(paired_kernel_vs_plain)->Apply(block_sizes)->Apply(in_pairs);

}  // namespace

}  // namespace dendrift::bench

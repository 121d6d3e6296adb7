#!/usr/bin/env bash
# ./benchmarks/run.sh [NAME ...] [--benchmark_...]
# Builds dendrift-bench and writes benchmarks/results/{2d,3d}.csv. Names select benchmarks by substring (their lines
# alone are then in the tables); other flags go to Google Benchmark.
# Variables:
#   DENDRIFT_BUILD   build folder (default: build/release)
#   OMP_NUM_THREADS  threads of the parts that use them (default: 1)
set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
build="${DENDRIFT_BUILD:-$root/build/release}"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
if [ "$(id -u)" -eq 0 ]; then
  export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fi

cmake -S "$root" -B "$build" -G Ninja -DCMAKE_BUILD_TYPE=Release -DDENDRIFT_BENCHMARKS=ON -Wno-dev --log-level=WARNING
if ! cmake --build "$build" --target dendrift_bench2d dendrift_bench3d; then
  echo "run.sh: dendrift-bench could not be built; Google Benchmark missing? (Debian: libbenchmark-dev)" >&2
  exit 1
fi
mkdir -p "$root/benchmarks/results"
for dim in 2d 3d; do
  json="$build/dendrift-bench-$dim.json"
  "$build/dendrift-bench$dim" "$@" >"$json"
  "${PYTHON:-python3}" "$root/benchmarks/to_csv.py" "$json" "$root/benchmarks/results/$dim.csv"
  echo "benchmarks/results/$dim.csv:"
  column -s, -t <"$root/benchmarks/results/$dim.csv"
done

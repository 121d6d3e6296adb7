#!/usr/bin/env bash
# ./run.sh [INPUT.toml] [section.key=value ...] [--restart FILE|DIR]
# Installs what is missing (Debian 12), builds, runs on all cores, draws, and names the files to look at.
# Exits with the program's code: 0 done, 2 bad input, 3 numerical failure, 4 input/output failure, 75 stopped on
# request after a checkpoint (SIGTERM or SIGUSR1; resume with --restart).
# Variables:
#   DENDRIFT_RANKS, DENDRIFT_THREADS  MPI ranks and OpenMP threads in each (default: one rank per core, one thread)
#   DENDRIFT_MPIEXEC_FLAGS            flags of mpirun (default: --oversubscribe --bind-to none)
set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
build="$root/build/release"
python="${PYTHON:-/usr/bin/python3}"

# --- 1. the input
case "${1:-}" in
  -h | --help) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//;p}' "${BASH_SOURCE[0]}"; exit 0 ;;
esac
input="$root/inputs/settling_dendrite.toml"
[ -f "$input" ] || input="$root/inputs/free_dendrite.toml"
if [ "$#" -gt 0 ] && [[ "$1" != *=* && "$1" != -* ]]; then
  input="$1"
  [ -f "$input" ] || [ ! -f "$root/$input" ] || input="$root/$input"
  shift
fi
if [ ! -f "$input" ]; then
  echo "run.sh: no input file '$input'" >&2
  exit 2
fi

# --- 2. packages and build; only the program of the input's dimension where that can be told
"$root/tools/setup_debian.sh" run

dimension() {
  local argument dim=""
  dim="$("$python" - "$input" 2>/dev/null <<'PYTHON' || true
import sys, tomllib
with open(sys.argv[1], "rb") as file:
    print(tomllib.load(file)["mesh"]["dim"])
PYTHON
)"
  for argument in "$@"; do
    [[ "$argument" != mesh.dim=* ]] || dim="${argument#mesh.dim=}"
  done
  echo "$dim"
}
case "$(dimension "$@")" in
  2) targets=(dendrift dendrift2d) ;;
  3) targets=(dendrift dendrift3d) ;;
  *) targets=(programs) ;;
esac
echo "run.sh: building ${targets[*]} in $build"
(cd "$root" && cmake --preset release -Wno-dev --log-level=WARNING)
cmake --build "$build" --parallel "$(nproc)" --target "${targets[@]}"

# --- 3. check the input, learn where the output goes
status=0
report="$("$build/dendrift" "$input" "$@" --check)" || status=$?
printf '%s\n' "$report"
[ "$status" -eq 0 ] || exit "$status"
output="$(sed -n 's/^[[:space:]]*output dir:[[:space:]]*//p' <<<"$report" | head -n 1)"

# --- 4. run
cores="$(nproc)"
physical="$(lscpu -p=CORE,SOCKET 2>/dev/null | grep -v '^#' | sort -u | wc -l || true)"
[ "$physical" -lt 1 ] || [ "$physical" -ge "$cores" ] || cores="$physical"
threads="${DENDRIFT_THREADS:-1}"
ranks="${DENDRIFT_RANKS:-$((cores / threads > 0 ? cores / threads : 1))}"
read -r -a mpi_flags <<<"${DENDRIFT_MPIEXEC_FLAGS---oversubscribe --bind-to none}"
export OMP_NUM_THREADS="$threads" OPENBLAS_NUM_THREADS=1
if [ "$(id -u)" -eq 0 ]; then
  export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fi

echo "run.sh: $input on $ranks ranks with $threads threads each"
mpirun -n "$ranks" "${mpi_flags[@]}" "$build/dendrift" "$input" "$@" &
mpirun_pid=$!
trap 'kill -USR1 "$mpirun_pid" 2>/dev/null || true' TERM USR1  # passed on to the ranks: checkpoint, exit 75
while true; do
  status=0
  wait "$mpirun_pid" || status=$?
  kill -0 "$mpirun_pid" 2>/dev/null || break  # otherwise it was the trap that ended the wait
done
trap - TERM USR1

# --- 5. draw, and name the files
if [ "$status" -ne 0 ] && [ "$status" -ne 75 ]; then
  echo "run.sh: the program ended with exit code $status; output so far in ${output:-(unknown)}" >&2
  exit "$status"
fi
plotted=0
if [ -n "$output" ] && compgen -G "$output/plt_*.hdf" >/dev/null; then
  "$python" "$root/tools/plot.py" "$output" --field phi,c --mesh --out "$output/final.png" || plotted=$?
  "$python" "$root/tools/plot.py" "$output" --film "$output/film.mp4" --field c ||
    echo "run.sh: no film could be made; the run itself is complete" >&2
fi

echo
[ "$status" -ne 75 ] || echo "Stopped on request; resume with: $0 $input $* --restart $output"
echo "Look at:"
for file in final.png film.mp4 plt.hdf.series grains.csv tips.csv diagnostics.csv manifest.json; do
  [ ! -s "$output/$file" ] || echo "  $output/$file"
done
if [ "$plotted" -ne 0 ]; then
  echo "run.sh: drawing $output/final.png failed; the data are complete" >&2
  [ "$status" -ne 0 ] || status=1
fi
exit "$status"

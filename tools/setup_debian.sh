#!/usr/bin/env bash
# Installs the Debian 12 packages that dendrift needs and that are missing.
#   tools/setup_debian.sh run    what run.sh needs: to build, run and draw
#   tools/setup_debian.sh test   that and what the tests and benchmarks need
#   tools/setup_debian.sh tsan   that and clang with its OpenMP runtime, for ./test.sh tsan
#   tools/setup_debian.sh slurm  the queue that tools/slurm_test.py starts, which ./test.sh does not need
# As root it calls apt-get; otherwise it prints the command for root and exits with 1.
set -euo pipefail

run_packages=(
  g++ cmake ninja-build pkg-config
  libopenmpi-dev openmpi-bin libhdf5-openmpi-dev libhypre-dev libmetis-dev
  libeigen3-dev libtomlplusplus-dev libcli11-dev libfmt-dev libspdlog-dev
  python3 python3-numpy python3-h5py python3-matplotlib ffmpeg
)
test_packages=(libgtest-dev libgmock-dev libbenchmark-dev python3-yt)
tsan_packages=(clang libomp-dev)
slurm_packages=(slurm-wlm munge)

group="${1:-run}"
case "$group" in
  run) wanted=("${run_packages[@]}") ;;
  test) wanted=("${run_packages[@]}" "${test_packages[@]}") ;;
  tsan) wanted=("${run_packages[@]}" "${test_packages[@]}" "${tsan_packages[@]}") ;;
  slurm) wanted=("${slurm_packages[@]}") ;;
  *) echo "setup: expected run, test, tsan or slurm, found '$group'" >&2; exit 2 ;;
esac

if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
  echo "setup: not a Debian system, installing nothing; Debian's names of what is needed:" >&2
  echo "setup:   ${wanted[*]}" >&2
  exit 0
fi

missing=()
for package in "${wanted[@]}"; do
  state="$(dpkg-query -W -f='${db:Status-Status}\n' "$package" 2>/dev/null || true)"
  grep -qx installed <<<"$state" || missing+=("$package")
done
if [ "${#missing[@]}" -eq 0 ]; then
  echo "setup: all ${#wanted[@]} packages of group '$group' are installed"
  exit 0
fi

if [ "$(id -u)" -ne 0 ]; then
  echo "setup: ${#missing[@]} packages are missing; as root, run" >&2
  echo "  apt-get update && apt-get install -y --no-install-recommends ${missing[*]}" >&2
  exit 1
fi
echo "setup: installing with apt-get: ${missing[*]}"
export DEBIAN_FRONTEND=noninteractive
apt-get update -q
apt-get install -y -q --no-install-recommends "${missing[@]}"

#!/usr/bin/env bash
# ./test.sh [asan|tsan] [-- CTEST ARGUMENTS]
# Installs what is missing (Debian 12), builds with the flags of a release, runs the whole test suite and ends with
# ctest's summary. asan: address and undefined-behaviour sanitizers; tsan: thread sanitizer.
set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
preset=ci
packages="test"
case "${1:-}" in
  asan) preset=asan; shift ;;
  tsan) preset=tsan; packages="tsan"; shift ;;
  "" | --) ;;
  *) echo "test.sh: expected asan, tsan or nothing, found '$1'" >&2; exit 2 ;;
esac
[ "${1:-}" != "--" ] || shift

if [ "$(id -u)" -eq 0 ]; then
  export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fi

"$root/tools/setup_debian.sh" "$packages"
cd "$root"
cmake --preset "$preset"
cmake --build "build/$preset" --parallel "$(nproc)"
exec ctest --test-dir "build/$preset" --output-on-failure --no-tests=error --parallel 2 "$@"

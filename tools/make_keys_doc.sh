#!/usr/bin/env bash
# Writes docs/keys.md, the list of input keys, from the declarations in the program.
#   tools/make_keys_doc.sh [BUILD_DIR]    BUILD_DIR holds an up-to-date `dendrift`; default: build/release
set -euo pipefail

root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
build="${1:-$root/build/release}"
if [ ! -x "$build/dendrift" ]; then
  echo "make_keys_doc: expected a program $build/dendrift, found none; build it, or name the folder of a build" >&2
  exit 2
fi
text="$("$build/dendrift" --keys --markdown)"
printf '%s\n' "$text" >"$root/docs/keys.md"
echo "make_keys_doc: wrote docs/keys.md, $(wc -l <"$root/docs/keys.md") lines"

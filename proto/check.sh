#!/usr/bin/env bash
# Check the protocol: Buf's lint rules, and no breaking change against the base version.
# The base is where the branch left main (or origin/main); on main it is the previous commit.
#   proto/check.sh [BUF]      BUF: path of the `buf` program, from the wheel buf-bin; else the one on the PATH
set -euo pipefail
cd "$(dirname "$0")/.."
buf="${1:-buf}"

"$buf" lint proto
echo "proto lint: clean"

base_of_branch() {
  local main base head
  head="$(git rev-parse HEAD)"
  for main in origin/main main; do
    base="$(git merge-base HEAD "$main" 2>/dev/null || true)"
    if [ -n "$base" ] && [ "$base" != "$head" ]; then
      echo "$base"
      return
    fi
  done
  git rev-parse --verify --quiet 'HEAD~1^{commit}' || true
}

if ! git rev-parse --verify --quiet HEAD >/dev/null 2>&1; then
  echo "proto breaking: skipped, this is no git checkout: there is no version before to compare with"
  exit 0
fi
base="$(base_of_branch)"
if [ -z "$base" ]; then
  echo "proto breaking: skipped, this checkout has one commit only: there is no version before to compare with"
  exit 0
fi
before="$(mktemp -d)"
trap 'rm -rf "$before"' EXIT
if ! git archive "$base" proto 2>/dev/null | tar -x -C "$before" 2>/dev/null; then
  echo "proto breaking: skipped, commit $base holds no folder proto, or is not in this clone"
  exit 0
fi
"$buf" breaking proto --against "$before/proto"
echo "proto breaking: nothing broken since $(git rev-parse --short "$base")"

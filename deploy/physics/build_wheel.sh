#!/usr/bin/env bash
# Build a wheel of PyBullet 3.2.7 from its source, for a Python or a processor without a wheel on the package index.
#
#   build_wheel.sh [PYTHON] [FOLDER]      default: python3, and dist
#
# The source needs no patch. Debug symbols are stripped, which makes the library 13 times smaller.
set -euo pipefail

version=3.2.7
python=${1:-python3}
out=$(mkdir -p "${2:-dist}" && cd "${2:-dist}" && pwd)

fail() {
  echo "physics-wheel: $1" >&2
  exit 2
}
command -v "$python" >/dev/null || fail "$python was not found: pass the Python to build for, as in make physics-wheel PYTHON=python3.12"
for tool in g++ strip; do
  command -v "$tool" >/dev/null || fail "$tool was not found: install a C++ compiler, on Debian with apt-get install g++"
done
headers=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
[[ -e $headers/Python.h ]] || fail "$headers has no Python.h: install the headers of $python, on Debian with apt-get install python3-dev"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"$python" -m venv "$work/build"
# numpy must be there: without it, PyBullet returns pictures as tuples. `-g0` and `strip`: see above.
"$work/build/bin/pip" install --quiet 'setuptools<81' wheel numpy
echo "building PyBullet $version for $("$python" --version): about five minutes on two cores" >&2
CFLAGS="${CFLAGS:-} -g0 -w" "$work/build/bin/pip" wheel --quiet --no-deps --no-build-isolation --no-binary=pybullet \
  --wheel-dir="$work" "pybullet==$version"
cd "$work"
"$work/build/bin/python" -m wheel unpack --dest unpacked pybullet-*.whl >/dev/null
strip --strip-unneeded unpacked/*/*.so
"$work/build/bin/python" -m wheel pack --dest-dir "$out" unpacked/* >/dev/null
ls "$out"/pybullet-"$version"-*.whl

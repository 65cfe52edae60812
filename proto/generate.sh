#!/usr/bin/env bash
# Generate the committed stubs beside the .proto files. CI runs this and then `git diff --exit-code -- proto`.
set -euo pipefail
root="$(cd "$(dirname "$0")" && pwd)"
python="${PYTHON:-python3}"
# protoc finds its mypy plugins on the PATH.
PATH="$(cd "$(dirname "$(command -v "$python")")" && pwd):$PATH"
"$python" -m grpc_tools.protoc -I "$root" \
  --python_out="$root" --grpc_python_out="$root" --mypy_out="$root" --mypy_grpc_out="$root" \
  "$root"/embomatrix/proto/v1/*.proto

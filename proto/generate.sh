#!/usr/bin/env bash
# Makes the stubs beside the .proto files. They are committed; CI runs this and then `git diff --exit-code -- proto`.
set -euo pipefail
cd "$(dirname "$0")"
python="${PYTHON:-python3}"
# protoc finds its mypy plugins on the PATH.
PATH="$(cd "$(dirname "$(command -v "$python")")" && pwd):$PATH"
"$python" -m grpc_tools.protoc -I . \
  --python_out=. --grpc_python_out=. --mypy_out=. --mypy_grpc_out=. \
  embomatrix/proto/v1/*.proto

#!/usr/bin/env bash
# Build the wheel, install it into an empty environment, and run the short demo to its page.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/python" -m pip --quiet wheel --no-deps --wheel-dir "$work" .
"$work/venv/bin/python" -m pip --quiet install --no-compile "$(ls "$work"/pronk-*.whl)"
du -sm "$work/venv"
"$work/venv/bin/python" -m pip --quiet install --no-compile onnxruntime
cd "$work"
"$work/venv/bin/pronk" demo --quick --out demo
test -s demo/report.html

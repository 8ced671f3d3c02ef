#!/usr/bin/env bash
# Installs CPU PyTorch beside the locked dependencies, for the learned baselines ('subiaco train').
# Run inside ros2_ws/env.sh (make learned does).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if python -c 'import torch' 2>/dev/null; then
    echo "[learned] PyTorch is installed: $(python -c 'import torch; print(torch.__version__)')"
    exit 0
fi
echo "[learned] installing CPU PyTorch (0.2 GB) into .venv"
if ! python -m pip install --quiet --no-deps --require-hashes --disable-pip-version-check \
    --extra-index-url https://download.pytorch.org/whl/cpu -r requirements.learned; then
    echo "[learned] PyTorch could not be installed; https://download.pytorch.org must be reachable, or set" >&2
    echo "[learned] PIP_FIND_LINKS to a folder with the wheels that requirements.learned names" >&2
    exit 1
fi
python -c 'import torch; print("[learned] PyTorch", torch.__version__)'

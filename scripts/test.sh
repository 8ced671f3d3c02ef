#!/usr/bin/env bash
# Every test, the files shared out over two workers. Run inside ros2_ws/env.sh (make test does); arguments go to
# pytest: `-n 0` runs all in one process.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

export OMP_NUM_THREADS="${OMP_NUM_THREADS:-2}" MPLBACKEND=Agg
exec python -m pytest -n 2 --dist loadfile "$@"

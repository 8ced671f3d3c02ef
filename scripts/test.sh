#!/usr/bin/env bash
# Every test, on a ROS domain of its own. Run inside ros2_ws/env.sh (make test does); arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Domains 1 to 101 keep clear of the ephemeral ports.
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-$((1 + $$ % 100))}"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-2}" MPLBACKEND=Agg
exec python -m pytest "$@"

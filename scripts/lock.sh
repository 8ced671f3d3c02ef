#!/usr/bin/env bash
# Renews requirements.lock: the whole closure of requirements.in for Python 3.11 and 3.12, with hashes. Versions
# that are locked stay where they still fit; with --upgrade, or --upgrade-package NAME, they move.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
uv="$(command -v uv || echo .venv/bin/uv)"
"$uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --override requirements.overrides \
    --custom-compile-command scripts/lock.sh "$@" requirements.in -o requirements.lock
# What the overrides leave out is named by uv with a marker that never holds. What something else needs too, on some
# Python at least, has a marker with an alternative, and stays.
awk '/^[^ #]/ { left_out = /sys_platform == .never./ && !/ or / } !left_out' requirements.lock >requirements.lock.part
mv requirements.lock.part requirements.lock

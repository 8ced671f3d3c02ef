# Source this (bash or zsh, from anywhere): virtual environment, ROS 2 workspace, DDS settings.
#
#   source ros2_ws/env.sh
#
# Several vehicles or hosts: set FASTRTPS_DEFAULT_PROFILES_FILE to a profile of your own first (see
# config/dds/README.md); what is set already is kept.
# shellcheck shell=bash

if [ -n "${ZSH_VERSION:-}" ]; then
    eval '_subiaco_file="${(%):-%x}"'
else
    _subiaco_file="${BASH_SOURCE[0]}"
fi
_subiaco_ws="$(cd "$(dirname "$_subiaco_file")" && pwd -P)"
_subiaco_root="$(dirname "$_subiaco_ws")"
_subiaco_shell="${ZSH_VERSION:+zsh}"
_subiaco_shell="${_subiaco_shell:-bash}"
_subiaco_apt="${SUBIACO_APT_ROS:-/opt/ros/jazzy}"

if [ ! -f "$_subiaco_root/.venv/bin/activate" ] || [ ! -f "$_subiaco_ws/install/.python" ]; then
    echo "ros2_ws/env.sh: nothing to source yet; run: make setup (in $_subiaco_root)" >&2
    unset _subiaco_file _subiaco_ws _subiaco_root _subiaco_shell _subiaco_apt
    return 1
fi

# The generated scripts read unset variables; the caller's `set -u` is put back afterwards.
case $- in *u*) _subiaco_nounset=1 && set +u ;; *) _subiaco_nounset= ;; esac

# shellcheck source=/dev/null
. "$_subiaco_root/.venv/bin/activate"
# shellcheck source=/dev/null
if [ -f "$_subiaco_apt/setup.$_subiaco_shell" ]; then . "$_subiaco_apt/setup.$_subiaco_shell"; fi
# shellcheck source=/dev/null
. "$_subiaco_ws/install/local_setup.$_subiaco_shell"
if [ ! -f "$_subiaco_apt/setup.$_subiaco_shell" ]; then
    # The wheels keep their shares in the virtual environment, which the generated scripts leave out.
    case ":${AMENT_PREFIX_PATH:-}:" in
        *":$VIRTUAL_ENV:"*) ;;
        *) export AMENT_PREFIX_PATH="${AMENT_PREFIX_PATH:+$AMENT_PREFIX_PATH:}$VIRTUAL_ENV" ;;
    esac
    # Leaks from a Python of the wheels into its children, and stops them from finding their libraries.
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
fi

# One host, loopback and shared memory, nothing lost: config/dds/loopback.xml.
export RMW_IMPLEMENTATION="${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}"
# A middleware that does not read that profile is kept on this host by the range.
case "$RMW_IMPLEMENTATION" in rmw_fastrtps_cpp) _subiaco_range=SYSTEM_DEFAULT ;; *) _subiaco_range=LOCALHOST ;; esac
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-$_subiaco_range}"
export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$_subiaco_root/config/dds/loopback.xml}"
export SUBIACO_ROOT="$_subiaco_root"

if [ -n "$_subiaco_nounset" ]; then set -u; fi
unset _subiaco_file _subiaco_ws _subiaco_root _subiaco_shell _subiaco_apt _subiaco_nounset _subiaco_range

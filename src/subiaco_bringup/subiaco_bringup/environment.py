"""The environment in which node processes run: workspace, loopback DDS, a domain of their own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from subiaco_bringup.defaults import dds_profile
from subiaco_geo.errors import SubiacoError

_FAST_DDS = "rmw_fastrtps_cpp"
_NEEDED = ("rclpy", "subiaco_msgs", "ouster_sensor_msgs", "tf2_msgs")


def _workspace_script() -> Path:
    root = os.environ.get("SUBIACO_ROOT")
    base = Path(root) if root else Path(__file__).resolve().parents[3]
    return base / "ros2_ws" / "env.sh"


def _sourced(script: Path) -> dict[str, str]:
    """Return the environment after sourcing a script in bash."""
    command = ["bash", "-c", 'source "$0" >&2 && env -0', str(script)]
    finished = subprocess.run(command, capture_output=True, check=False)
    if finished.returncode != 0:
        complaint = finished.stderr.decode(errors="replace").strip().splitlines()
        raise SubiacoError(f"{script}: {complaint[-1] if complaint else 'failed'}")
    pairs = (entry.split("=", 1) for entry in finished.stdout.decode().split("\0") if "=" in entry)
    return {key: value for key, value in pairs if key not in ("SHLVL", "_")}


def workspace_environment() -> dict[str, str]:
    """Return an environment in which the nodes' packages are found.

    Raises
    ------
    SubiacoError
        The workspace has not been built.
    """
    if all(importlib.util.find_spec(name) is not None for name in _NEEDED):
        return dict(os.environ)
    script = _workspace_script()
    if not script.is_file():
        raise SubiacoError("the ROS 2 workspace was not found; run 'make setup', or source its setup.bash")
    return _sourced(script)


def dds_defaults(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the DDS settings that an environment lacks: this host alone is spoken to.

    The shipped profile binds loopback and shared memory and wants the range ``SYSTEM_DEFAULT``
    (``LOCALHOST`` would add small transports of its own). Where it is not read, ``LOCALHOST`` it is.
    """
    profile = dds_profile()
    defaults = {"RMW_IMPLEMENTATION": _FAST_DDS, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    if environment.get("RMW_IMPLEMENTATION", _FAST_DDS) == _FAST_DDS and profile is not None:
        defaults["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
        defaults["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
    return {name: value for name, value in defaults.items() if name not in environment}


def _with_defaults(environment: dict[str, str], log_directory: str) -> dict[str, str]:
    result = {
        **dds_defaults(environment),
        "ROS_LOG_DIR": log_directory,
        **environment,
        "RCUTILS_COLORIZED_OUTPUT": "0",
        "RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{severity}] {message}",
        "PYTHONUNBUFFERED": "1",
        "SUBIACO_SUPERVISOR": str(os.getpid()),
    }
    result.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return result


@contextmanager
def node_environment(*, shared: bool = False) -> Iterator[dict[str, str]]:
    """Yield the environment of one run; runs side by side do not hear each other.

    ``ROS_DOMAIN_ID`` is taken from the caller's environment where it is set,
    else a free one is held until the end. ``shared`` runs stay in the caller's
    domain, or the default one, because they listen to nodes that are not ours.
    """
    import domain_coordinator  # type: ignore[import-untyped]  # comes with ROS

    with TemporaryDirectory(prefix="subiaco-ros-") as logs:
        environment = _with_defaults(workspace_environment(), logs)
        if shared or "ROS_DOMAIN_ID" in os.environ:
            yield environment
            return
        held = domain_coordinator.domain_id()  # not as a `with`: it would swallow an OSError of ours
        number = held.__enter__()
        try:
            yield {**environment, "ROS_DOMAIN_ID": str(number)}
        finally:
            held.__exit__(None, None, None)

"""Who already publishes sensor data in a ROS domain: a replay there would end up in a recording."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Collection, Mapping

from subiaco_geo.errors import InputError
from subiaco_geo.topics import FIX, IMU, IMU_PACKETS, LIDAR_PACKETS, POINTS

_TOPICS = (LIDAR_PACKETS, IMU_PACKETS, POINTS, IMU, FIX)
_SECONDS = 4.0  # until nodes on one busy host have found each other

#: Run in the environment of the nodes; prints the nodes at any of the topics as JSON.
_PROGRAM = """
import json, sys, time
import rclpy
from rclpy.executors import SingleThreadedExecutor
rclpy.init()
node = rclpy.create_node("subiaco_domain_check")
executor = SingleThreadedExecutor()
executor.add_node(node)
end = time.monotonic() + float(sys.argv[1])
found, unnamed = set(), False
while time.monotonic() < end and not found:
    executor.spin_once(timeout_sec=0.1)
    for topic in sys.argv[2:]:
        ends = node.get_publishers_info_by_topic(topic) + node.get_subscriptions_info_by_topic(topic)
        names = {f"{e.node_namespace.rstrip('/')}/{e.node_name}" for e in ends}
        unnamed |= any("_UNKNOWN_" in name for name in names)  # found before its node told its name
        found |= {name for name in names if "_UNKNOWN_" not in name}
print(json.dumps(sorted(found) or ["a node without a name"] * unnamed))
rclpy.try_shutdown()
"""


def require_free_domain(environment: Mapping[str, str]) -> None:
    """Refuse a ROS domain in which other nodes send or take sensor data.

    Parameters
    ----------
    environment : mapping
        Of the nodes that are about to start.

    Raises
    ------
    InputError
        A node publishes or subscribes to the topics that a replay publishes.
    """
    nodes = _nodes_at(environment, _TOPICS)
    if nodes:
        domain = environment.get("ROS_DOMAIN_ID", "0")
        raise InputError(
            f"ROS_DOMAIN_ID={domain}: {', '.join(sorted(nodes)[:3])} already send or record sensor data in"
            " this domain, and a replay would mix with them; unset ROS_DOMAIN_ID, or choose another"
        )


def _nodes_at(environment: Mapping[str, str], topics: Collection[str]) -> set[str]:
    command = [sys.executable, "-c", _PROGRAM, str(_SECONDS), *topics]
    finished = subprocess.run(
        command, env=dict(environment), capture_output=True, check=False, timeout=60, text=True
    )
    if finished.returncode != 0:  # the nodes will say better why ROS does not start
        return set()
    return set(json.loads(finished.stdout.splitlines()[-1]))

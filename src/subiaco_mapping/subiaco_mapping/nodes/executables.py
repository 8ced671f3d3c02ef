"""What ``ros2 run`` and ``ros2 launch`` start: nodes whose imports an interruption does not break."""

from __future__ import annotations

from subiaco_ros.node_process import start


def replay_node() -> int:
    """Play bags onto topics."""
    return start("subiaco_mapping.nodes.replay_node")


def recorder_node() -> int:
    """Record topics."""
    return start("subiaco_mapping.nodes.recorder_node")


def monitor_node() -> int:
    """Watch the health of the sensors."""
    return start("subiaco_mapping.nodes.monitor_node")


def odometry_node() -> int:
    """Register scans."""
    return start("subiaco_mapping.nodes.odometry_node")


def pose_graph_node() -> int:
    """Solve the pose graph and build the map."""
    return start("subiaco_mapping.nodes.pose_graph_node")

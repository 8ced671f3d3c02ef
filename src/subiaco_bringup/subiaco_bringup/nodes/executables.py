"""What ``ros2 run`` and ``ros2 launch`` start: nodes whose imports an interruption does not break."""

from __future__ import annotations

from subiaco_ros.node_process import start


def change_node() -> int:
    """Compare two maps."""
    return start("subiaco_bringup.nodes.change_node")


def foxglove_node() -> int:
    """Serve topics to Foxglove."""
    return start("subiaco_bringup.nodes.foxglove_node")


def composed_nodes() -> int:
    """Run several nodes in one process."""
    return start("subiaco_bringup.nodes.composed_nodes")

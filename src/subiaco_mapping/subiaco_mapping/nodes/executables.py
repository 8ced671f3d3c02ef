"""What ``ros2 run`` and ``ros2 launch`` start: nodes whose imports an interruption does not break."""

from __future__ import annotations

import importlib
import signal


def start(module: str) -> int:
    """Import the module of a node with SIGINT blocked, and run it; a pending one arrives then."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return int(importlib.import_module(module).main())


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

"""What ``ros2 run`` and ``ros2 launch`` start."""

from __future__ import annotations

from subiaco_mapping.nodes.executables import start


def change_node() -> int:
    """Compare two maps."""
    return start("subiaco_change.nodes.change_node")

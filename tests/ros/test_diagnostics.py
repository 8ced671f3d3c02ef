"""A status carries node, task and hardware; it comes at once when it changes, else once a second."""

from __future__ import annotations

from typing import Any

import pytest

pytestmark = pytest.mark.ros


def test_a_status_is_named_by_node_and_task_and_carries_its_hardware(ros: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    from subiaco_ros.diagnostics import Diagnostics

    said = ros.collect(ros.node("reader"), DiagnosticArray, "/diagnostics", latched=False)
    node = ros.node("front", namespace="/left")
    diagnostics = Diagnostics(node, "registration", "OS-1-128 992112000123")
    ros.until(lambda: node.count_subscribers("/diagnostics"))
    diagnostics.report("fine", {"scans": 3})
    ros.until(lambda: said)
    (status,) = said[0].status
    assert (status.name, status.hardware_id) == ("left/front: registration", "OS-1-128 992112000123")
    assert (status.level, status.message) == (DiagnosticStatus.OK, "fine")
    assert [(v.key, v.value) for v in status.values] == [("scans", "3")]
    for count in range(4, 30):
        diagnostics.report("fine", {"scans": count})
    diagnostics.report("degenerate", {"scans": 30}, warn=True)
    ros.until(lambda: len(said) == 2)  # the counts alone are no reason to publish
    assert said[1].status[0].level == DiagnosticStatus.WARN
    ros.until(lambda: len(said) == 3, timeout=3.0)  # repeated, so that an aggregator sees that the node lives
    assert said[2].status[0] == said[1].status[0]


@pytest.mark.parametrize(
    ("metadata", "identity"),
    [
        ('{"prod_line": "OS-1-128", "prod_sn": "9921"}', "OS-1-128 9921"),
        ('{"sensor_info": {"prod_line": "OS-0-64", "prod_sn": "7"}}', "OS-0-64 7"),
        ("{}", "none"),
        ("no json", "none"),
        ("[1]", "none"),
    ],
)
def test_the_identity_of_a_lidar_comes_from_its_metadata(metadata: str, identity: str) -> None:
    pytest.importorskip("diagnostic_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")
    from subiaco_ros.diagnostics import lidar_identity

    assert lidar_identity(metadata) == identity


def test_progress_is_latched_in_steps_for_whoever_comes_late(
    ros: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from diagnostic_msgs.msg import DiagnosticStatus

    from subiaco_ros.diagnostics import ProgressReporter
    from subiaco_ros.supervision import CHANNEL

    monkeypatch.delenv(CHANNEL, raising=False)
    node = ros.node("pose_graph")
    seen = ros.collect(ros.node("reader"), DiagnosticStatus, "progress")
    report = ProgressReporter(node, step=0.1)
    ros.until(lambda: node.count_subscribers("progress"))
    for fraction in (0.0, 0.05, 0.12, 0.15, 1.0, 1.0):
        report("fusing scans", fraction)
    ros.until(lambda: len(seen) == 3)
    late = ros.collect(ros.node("late"), DiagnosticStatus, "progress")
    ros.until(lambda: late)
    for status, fraction in zip([*seen, late[0]], ["0.0000", "0.1200", "1.0000", "1.0000"], strict=True):
        assert (status.name, status.message) == ("pose_graph", "fusing scans")
        assert [(v.key, v.value) for v in status.values] == [("fraction", fraction)]

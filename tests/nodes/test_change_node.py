"""The change node with a library step of ours in place of the real one."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shapely.geometry import box

from subiaco_change.config import ChangeConfig
from subiaco_change.outputs.preview import build_preview
from subiaco_change.records import ChangeRecord, ChangeResult, Registration
from subiaco_change.request import ChangeRequest
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError, RegistrationError

pytestmark = pytest.mark.ros

NAN = float("nan")


def labelled(xyz: np.ndarray, change: Change, crs: str | None, origin: np.ndarray) -> PointCloud:
    n = len(xyz)
    return PointCloud(
        xyz,
        origin,
        crs,
        {
            "change": np.full(n, change, np.uint8),
            "semantic": np.full(n, Semantic.BUILDING, np.uint8),
            "instance": np.full(n, 7, np.int32),
            "confidence": np.full(n, 0.5, np.float32),
            "lod95": np.full(n, 0.1, np.float32),
        },
    )


def record(object_id: int, change: Change, **values: Any) -> ChangeRecord:
    numbers = {
        "delta_h_m": 1.5,
        "delta_v_m3": -2.0,
        "delta_v_surface_m3": NAN,
        "delta_c_m": NAN,
        "iou_3d": NAN,
    }
    numbers |= {
        "d_perp_m": 0.2,
        "lod95_m": 0.1,
        "observed_fraction": 0.9,
        "score_paper": NAN,
        "confidence": 0.8,
    }
    return ChangeRecord(
        object_id=object_id,
        semantic=Semantic.BUILDING,
        change=change,
        id_before=(),
        id_after=(3, 4),
        match_kind="none",
        evidence="observed",
        n_before=0,
        n_after=np.int64(8),
        x=390_000.25,
        y=6_460_000.5,
        z=20.0,
        footprint=box(390_000, 6_460_000, 390_002, 6_460_004),
        reason="seen only later",
        **numbers,
        **values,
    )


def make_result(crs: str | None = "EPSG:7850") -> ChangeResult:
    origin = np.array([390_000.0, 6_460_000.0, 10.0]) if crs else np.zeros(3)
    corners = np.stack(np.meshgrid([0.0, 2.0], [0.0, 4.0], [0.0, 6.0]), axis=-1).reshape(-1, 3)
    registration = Registration(np.eye(4), origin, 0.01, 0.02, 0.9, np.zeros(6), "given")
    return ChangeResult(
        (record(7, Change.ADDED), record(8, Change.UNCHANGED)),
        labelled(corners[:0], Change.ADDED, crs, origin),
        labelled(corners, Change.ADDED, crs, origin),
        registration,
        None,
    )


def make_app(ros: Any, detect: Any, **parameters: Any) -> Any:
    from subiaco_change.nodes.change_node import ChangeApp, ChangeParameters
    from subiaco_ros.parameters import read_models

    node = ros.node("change", **parameters)
    own, config = read_models(node, ChangeParameters, ChangeConfig)
    app = ChangeApp(node, own, config, detect)
    ros.apps.append(app)
    return app


def outcome(result: ChangeResult) -> Any:
    from subiaco_change.nodes.job import Outcome

    return Outcome(build_preview(result, 1_000), 1_700_000_000_000_000_000)


class ActionUser:
    """Send one goal and follow it."""

    def __init__(self, ros: Any, **goal: Any) -> None:
        from rclpy.action import ActionClient

        from subiaco_msgs.action import DetectChanges

        self.ros = ros
        self.client = ActionClient(ros.node("user"), DetectChanges, "change/detect")
        ros.until(self.client.server_is_ready)
        self.feedback: list[Any] = []
        sent = self.client.send_goal_async(
            DetectChanges.Goal(**goal), feedback_callback=lambda m: self.feedback.append(m.feedback)
        )
        ros.until(sent.done)
        self.handle = sent.result()

    def result(self) -> Any:
        future = self.handle.get_result_async()
        self.ros.until(future.done)
        return future.result()


def test_a_goal_gives_feedback_by_stage_and_the_table_as_result(ros: Any) -> None:
    from action_msgs.msg import GoalStatus

    asked: list[Any] = []
    seen_first = threading.Event()

    def detect(request: Any, report: Any, _on_tile: Any) -> Any:
        asked.append(request)
        report("registration", 0.25)
        assert seen_first.wait(20)
        return outcome(make_result())

    make_app(ros, detect)
    user = ActionUser(ros, before="a", after="b", output="c", overwrite=True)
    ros.until(lambda: any(f.stage == "registration" for f in user.feedback))
    seen_first.set()
    answer = user.result()
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.success
    assert answer.result.message == "c"
    assert asked[0].before == Path("a")
    assert asked[0].overwrite
    row = answer.result.table.records[0]
    assert (row.object_id, row.object_class, row.change) == (7, row.CLASS_BUILDING, row.CHANGE_ADDED)
    assert (row.match_kind, row.evidence) == (row.MATCH_NONE, row.EVIDENCE_OBSERVED)
    assert row.object_uid
    (ring,) = row.footprint
    corners = np.array([[p.x, p.y, p.z] for p in ring.points])
    assert corners.shape == (4, 3)
    assert np.ptp(corners, axis=0) == pytest.approx(
        [2, 4, 0], abs=0.06
    )  # float32 about the origin of the map
    assert np.abs(corners).max() < 20
    assert list(row.id_after) == [3, 4]
    assert (row.x, row.y) == (390_000.25, 6_460_000.5)
    assert np.isnan(row.iou_3d)
    table = answer.result.table
    counts = dict(zip(table.changes, table.counts, strict=True))
    assert counts == {row.CHANGE_ADDED: 1, row.CHANGE_UNCHANGED: 1}


def test_the_outcome_is_latched_as_local_clouds_table_and_markers(ros: Any) -> None:
    from sensor_msgs.msg import NavSatFix, PointCloud2
    from visualization_msgs.msg import Marker, MarkerArray

    from subiaco_mapping.preprocessing.conversions import cloud_array
    from subiaco_msgs.msg import ChangeTable

    make_app(ros, lambda *_: outcome(make_result()))
    assert ActionUser(ros, before="a", after="b", output="c").result().result.success
    late = ros.node("late")
    clouds = ros.collect(late, PointCloud2, "change/after")
    tables = ros.collect(late, ChangeTable, "change/table")
    markers = ros.collect(late, MarkerArray, "change/markers")
    origins = ros.collect(late, NavSatFix, "change/origin")
    ros.until(lambda: clouds and tables and markers and origins)
    points = cloud_array(clouds[0])
    assert clouds[0].header.frame_id == "map"
    assert points.dtype["x"] == np.float32
    assert set(points.dtype.names) == {
        "x",
        "y",
        "z",
        "change",
        "semantic",
        "instance",
        "confidence",
        "lod95",
        "rgb",
    }
    # The grid is turned by the convergence (0.6 deg here) against true north, and scaled by 0.9997.
    assert np.hypot(points["x"], points["y"]).max() == pytest.approx(np.hypot(2, 4), abs=0.01)
    assert points["x"].max() == pytest.approx(2.0, abs=0.06)
    assert points["z"].max() == pytest.approx(6.0, abs=0.001)
    assert origins[0].latitude == pytest.approx(-31.98, abs=0.02)
    assert tables[0].crs == "EPSG:7850"
    boxes = [m for m in markers[0].markers if m.ns == "objects" and m.action == Marker.ADD]
    texts = [m.text for m in markers[0].markers if m.type == Marker.TEXT_VIEW_FACING]
    assert texts == ["7 building Added"]
    assert boxes[0].scale.z == pytest.approx(6.0, abs=0.01)
    assert boxes[0].color.g == pytest.approx(160 / 255)


def test_a_goal_can_be_cancelled_between_two_stages(ros: Any) -> None:
    from action_msgs.msg import GoalStatus

    def detect(_request: Any, report: Any, _on_tile: Any) -> Any:
        for _ in range(2000):
            report("registration", 0.1)
            threading.Event().wait(0.01)
        raise AssertionError("was not cancelled")

    make_app(ros, detect)
    user = ActionUser(ros, before="a", after="b", output="c")
    ros.until(lambda: user.feedback)
    user.handle.cancel_goal_async()
    answer = user.result()
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert not answer.result.success


def test_a_failed_goal_is_aborted_with_the_reason_and_the_next_one_runs(ros: Any) -> None:
    from action_msgs.msg import GoalStatus

    errors: list[Exception] = [RegistrationError("the maps do not overlap")]

    def detect(*_: Any) -> Any:
        if errors:
            raise errors.pop()
        return outcome(make_result(None))

    make_app(ros, detect)
    user = ActionUser(ros, before="a", after="b", output="c")
    answer = user.result()
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.message == "the maps do not overlap"
    assert ActionUser(ros, before="a", after="b", output="c").result().result.success


def test_one_comparison_at_a_time(ros: Any) -> None:
    release = threading.Event()

    def detect(*_: Any) -> Any:
        assert release.wait(20)
        return outcome(make_result(None))

    make_app(ros, detect)
    first = ActionUser(ros, before="a", after="b", output="c")
    second = ActionUser(ros, before="a", after="b", output="d")
    assert first.handle.accepted
    assert not second.handle.accepted
    release.set()
    assert first.result().result.success


def test_a_comparison_given_by_parameters_runs_at_once_and_ends_the_node(ros: Any) -> None:
    app = make_app(
        ros,
        lambda *_: outcome(make_result(None)),
        request='{"before": "a", "after": "b", "output": "c"}',
        exit_at_end=True,
    )
    ros.until(lambda: app.done)


def test_the_error_of_a_comparison_given_by_parameters_ends_the_node(ros: Any) -> None:
    def detect(*_: Any) -> Any:
        raise RegistrationError("cannot be trusted")

    app = make_app(ros, detect, request='{"before": "a", "after": "b", "output": "c"}', exit_at_end=True)
    with pytest.raises(RegistrationError, match="cannot be trusted"):
        ros.until(lambda: app.done)


WRONG = {
    "half a comparison": ('{"before": "a"}', "after: Field required"),
    "not JSON": ("before: a", "not valid JSON"),
    "an unknown option": (
        '{"before": "a", "after": "b", "output": "c", "parcel": "d"}',
        "did you mean parcels",
    ),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_a_parameter_that_is_no_request_is_refused_and_named(ros: Any, name: str) -> None:
    text, said = WRONG[name]
    with pytest.raises(InputError, match=f"parameter request: .*{said}"):
        make_app(ros, lambda *_: None, request=text)


def test_a_goal_says_every_option_in_json_and_the_node_fills_in_its_own_settings(ros: Any) -> None:
    asked: list[Any] = []
    asked_twice = {
        "before": "x",
        "output": "c",
        "workers": 2,
        "config": {"leaf": 0.5},
        "transform": "identity",
    }

    def detect(request: Any, _report: Any, on_tile: Any) -> Any:
        asked.append(request)
        on_tile("waiting", "4_7")
        threading.Event().wait(0.5)
        return outcome(make_result())

    make_app(ros, detect, **{"decisions.min_observed": 0.5, "leaf": 0.3})
    user = ActionUser(ros, before="a", after="b", request_json=json.dumps(asked_twice))
    assert user.result().result.success
    (request,) = asked
    assert request == ChangeRequest.of(
        before="a", after="b", output="c", workers=2, transform=np.eye(4),
        config={"leaf": 0.5, "decisions": {"min_observed": 0.5}},
    )  # fmt: skip
    assert "4_7" in {told.tile for told in user.feedback}


def test_a_goal_that_is_no_request_is_aborted_with_the_reason(ros: Any) -> None:
    make_app(ros, lambda *_: outcome(make_result()))
    answer = ActionUser(ros, before="a", after="b", output="c", request_json='{"workers": 0}').result().result
    assert not answer.success
    assert "workers" in answer.message
    assert ActionUser(ros, before="a", after="b", output="c").result().result.success


@pytest.mark.parametrize("transition", ["cleanup", "shutdown"])
def test_a_node_that_is_put_away_ends_its_comparison_and_the_goal_fails(ros: Any, transition: str) -> None:
    from action_msgs.msg import GoalStatus, GoalStatusArray
    from rclpy.lifecycle import TransitionCallbackReturn

    from subiaco_change.nodes.change_node import ChangeApp, ChangeParameters
    from subiaco_ros.parameters import read_models

    begun, ended = threading.Event(), threading.Event()

    def detect(_request: Any, report: Any, _on_tile: Any) -> Any:
        begun.set()
        try:
            while True:
                report("objects", 0.5)
        finally:
            ended.set()

    def build(node: Any) -> ChangeApp:
        own, config = read_models(node, ChangeParameters, ChangeConfig)
        return ChangeApp(node, own, config, detect)

    node = ros.managed("change", build)
    node.start()
    watcher = ros.node("watcher")
    told = ros.collect(watcher, GoalStatusArray, "change/detect/_action/status")
    user = ActionUser(ros, before="a", after="b", output="c")
    assert user.handle.accepted
    ros.until(begun.is_set)
    if transition == "cleanup":
        assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    getattr(node, f"trigger_{transition}")()
    assert ended.is_set()
    ros.until(lambda: told and told[-1].status_list[-1].status == GoalStatus.STATUS_ABORTED)
    assert node.app is None
    assert node.finished == (transition == "shutdown")
    for _ in range(10):
        ros.executor.spin_once(timeout_sec=0.01)
    if transition == "cleanup":
        begun.clear()
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
        assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
        again = ActionUser(ros, before="a", after="b", output="c")
        assert again.handle.accepted
        ros.until(begun.is_set)
        node.put_away()

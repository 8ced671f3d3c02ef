"""The pose-graph node around a back end of ours."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3
from subiaco_geo.maps import read_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_mapping.measurements import DeskewedScan, OdometryPose

pytestmark = pytest.mark.ros

T0_NS = 1_697_335_200_000_000_000
T_BASE_LIDAR = exp_se3(np.array([0.0, 0.0, 0.2, 0.5, 0.0, 1.9]))
ENU = EnuFrame(-31.948, 115.825, 20.0)


class FakeBackend:
    """Keep what comes; solve by taking the odometry for the truth."""

    def __init__(self, crs: str | None = "EPSG:7850") -> None:
        self.crs = crs
        self.sequences: list[tuple[str, Any]] = []
        self.taken: list[tuple[OdometryPose, DeskewedScan]] = []
        self.fixes: list[Any] = []
        self.facts: dict[str, Any] = {}
        self.inputs: dict[str, str] = {}
        self.T_local_odom = np.eye(4)

    def start_sequence(self, name: str, extrinsics: Any = None) -> None:
        self.sequences.append((name, extrinsics))

    def add_facts(self, **facts: Any) -> None:
        self.facts |= facts

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        self.taken.append((pose, scan))

    def on_fix(self, fix: Any) -> None:
        self.fixes.append(fix)

    def optimize(self) -> Any:
        from subiaco_mapping.survey_graph.solution import GraphSolution, SequenceSolution

        if not self.taken:
            raise InputError("no scan")
        stamps = np.array([pose.stamp_ns for pose, _ in self.taken])
        poses = np.array([pose.T_odom_lidar for pose, _ in self.taken])
        covariance = np.zeros((len(stamps), 6, 6))
        used = len(self.fixes)
        sequence = SequenceSolution(
            self.sequences[0][0], stamps, poses, covariance, self.T_local_odom, used, 0, 0, 0
        )
        return GraphSolution((sequence,), ENU if self.crs else None, None if self.crs else "no fix")

    def preview(self) -> Any:
        return self.optimize()

    def with_quality(self, survey: SurveyMap, progress: Any = None) -> SurveyMap:
        return replace(survey, pages={"quality.html": f"of {len(survey.cloud)} points"})

    def build_map(self, progress: Any = None, inputs: Any = None) -> SurveyMap:
        self.inputs = dict(inputs or {})
        if progress is not None:
            progress("fusing scans", 1.0)
        local = np.concatenate([scan.xyz for _, scan in self.taken])
        world = ENU.points_to_map(local, self.crs) if self.crs else local
        origin = world.mean(axis=0).round(-2) if self.crs else np.zeros(3)
        normals = np.tile([0.0, 0.0, 1.0], (len(world), 1))
        fields = {
            "intensity": np.arange(len(world), dtype=np.float32),
            "normals": normals,
            "n": np.ones(len(world), np.uint16),
            "spread": np.zeros(len(world), np.float32),
        }
        stamps = np.array([pose.stamp_ns for pose, _ in self.taken])
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3, 3] = origin
        return SurveyMap(PointCloud(world - origin, origin, self.crs, fields), Trajectory(stamps, poses))


#: Where the sensors sit, by parameters; else live topics wait for /tf_static.
PLACES = {"sensors__lidar__translation": [0.0, 0.0, 2.0], "sensors__gnss__translation": [0.0, 0.0, 2.2]}


class Bench:
    """A pose-graph node with a fake back end, and a tester that plays odometry and replay."""

    def __init__(self, ros: Any, backend: Any, **parameters: Any) -> None:
        from nav_msgs.msg import Odometry
        from nav_msgs.msg import Path as PathMessage
        from sensor_msgs.msg import NavSatFix, PointCloud2
        from std_msgs.msg import String

        from subiaco_mapping.config import MappingConfig
        from subiaco_mapping.nodes.pose_graph_node import PoseGraphApp, PoseGraphParameters
        from subiaco_msgs.msg import ReplayCounts, ScanQuality
        from subiaco_ros.parameters import read_models
        from subiaco_ros.qos import latched, reliable
        from tf2_msgs.msg import TFMessage

        self.ros, self.backend = ros, backend
        node = ros.node("pose_graph", **parameters)
        own, config = read_models(node, PoseGraphParameters, MappingConfig)
        self.app = PoseGraphApp(node, own, config, backend)
        ros.apps.append(self.app)
        user = self.user = ros.node("tester")
        self.paths = ros.collect(user, PathMessage, "path", 1)
        self.points = ros.collect(user, PointCloud2, "map/points", 1)
        self.origins = ros.collect(user, NavSatFix, "map/origin", 1)
        self.tf = ros.collect(user, TFMessage, "tf", latched=False)
        self.static = ros.collect(user, TFMessage, "tf_static")
        self.consumed = ros.collect(user, ReplayCounts, "replay/consumed")
        self.out = {
            "tf_static": user.create_publisher(TFMessage, "tf_static", latched(1)),
            "fix": user.create_publisher(NavSatFix, "gnss/fix", reliable(100)),
            "odometry": user.create_publisher(Odometry, "odometry", reliable(100)),
            "quality": user.create_publisher(ScanQuality, "odometry/quality", reliable(100)),
            "cloud": user.create_publisher(PointCloud2, "points_deskewed", reliable(100)),
            "sky": user.create_publisher(PointCloud2, "points_sky", reliable(100)),
            "facts": user.create_publisher(String, "odometry/facts", latched(32)),
            "announce": user.create_publisher(ReplayCounts, "replay/sequence", latched(1)),
            "sequence": user.create_publisher(ReplayCounts, "odometry/sequence", latched(1)),
            "end": user.create_publisher(ReplayCounts, "odometry/end", latched(1)),
        }
        ros.until(lambda: all(p.get_subscription_count() for p in self.out.values()))
        self.sent = 0

    def taken(self, topic: str) -> int:
        reports = [m for m in self.consumed if m.source == "pose_graph"]
        return dict(zip(reports[-1].topics, reports[-1].counts, strict=True))[topic] if reports else -1

    def begin(self, name: str = "one", topics: tuple[str, ...] = ("/gnss/fix",)) -> None:
        from subiaco_msgs.msg import ReplayCounts
        from subiaco_ros.messages import transform_message
        from tf2_msgs.msg import TFMessage

        before = self.taken("/replay/sequence")
        self.out["announce"].publish(ReplayCounts(source=name, topics=topics, counts=[1] * len(topics)))
        self.out["sequence"].publish(ReplayCounts(source=name, topics=["/odometry"], counts=[self.sent]))
        self.ros.until(lambda: self.taken("/replay/sequence") == max(before, 0) + 1)
        before = self.taken("/tf_static")
        transforms = [
            transform_message(T_BASE_LIDAR, "base_link", "lidar_link", 0),
            transform_message(np.eye(4), "base_link", "gnss_link", 0),
        ]
        self.out["tf_static"].publish(TFMessage(transforms=transforms))
        self.ros.until(lambda: self.taken("/tf_static") == before + 1)

    def scan(self, order: tuple[str, ...] = ("odometry", "quality", "sky", "cloud")) -> None:
        from subiaco_mapping.nodes.messages import (
            odometry_message,
            quality_message,
            scan_message,
            sky_message,
        )

        self.sent += 1
        stamp = T0_NS + self.sent * 100_000_000
        rng = np.random.default_rng(self.sent)
        xyz = rng.uniform(-20, 20, (50, 3))
        scan = DeskewedScan(stamp, xyz, np.ones(50, np.float32), "gyro")
        pose = OdometryPose(
            stamp, exp_se3(np.full(6, 0.1 * self.sent)), np.eye(6), 9, 0.1, degenerate=False, segment=0
        )
        messages = {
            "odometry": odometry_message(pose, T_BASE_LIDAR, np.eye(6), "odom", "base_link"),
            "quality": quality_message(pose, scan, "lidar_link"),
            "cloud": scan_message(scan, "lidar_link"),
            "sky": sky_message(scan, "lidar_link"),
        }
        for name in order:
            self.out[name].publish(messages[name])

    def end(self, scans: int | None = None) -> None:
        from subiaco_msgs.msg import ReplayCounts

        count = self.sent if scans is None else scans
        topics = ["/odometry", "/points_deskewed", "/points_sky", "/odometry/quality"]
        self.out["end"].publish(ReplayCounts(source="odometry", topics=topics, counts=[count] * 4))


def test_pose_and_scan_of_one_stamp_reach_the_back_end_in_order(ros: Any) -> None:
    bench = Bench(ros, FakeBackend())
    bench.begin()
    bench.scan()
    bench.scan(("cloud", "quality", "odometry", "sky"))
    ros.until(lambda: len(bench.backend.taken) == 2)
    assert [name for name, _ in bench.backend.sequences] == ["one"]
    np.testing.assert_allclose(bench.backend.sequences[0][1].T_base_lidar, T_BASE_LIDAR, atol=1e-12)
    for k, (pose, scan) in enumerate(bench.backend.taken, 1):
        assert pose.stamp_ns == scan.stamp_ns == T0_NS + k * 100_000_000
        np.testing.assert_allclose(pose.T_odom_lidar, exp_se3(np.full(6, 0.1 * k)), atol=1e-12)
        xyz = np.random.default_rng(k).uniform(-20, 20, (50, 3))
        np.testing.assert_allclose(scan.xyz, xyz, atol=2e-6)


def test_fixes_go_to_the_back_end_whether_they_are_good_or_not(ros: Any) -> None:
    from sensor_msgs.msg import NavSatFix

    bench = Bench(ros, FakeBackend())
    bench.begin()
    for latitude in (-31.9, float("nan")):
        bench.out["fix"].publish(NavSatFix(latitude=latitude))
    ros.until(lambda: bench.taken("/gnss/fix") == 2)
    assert bench.backend.fixes[0].latitude == -31.9
    assert not bench.backend.fixes[1].is_usable()


def test_the_end_waits_for_the_last_scan_and_then_writes_the_map(ros: Any, tmp_path: Path) -> None:
    out = tmp_path / "map"
    bench = Bench(ros, FakeBackend(), output_directory=str(out), exit_at_end=True)
    bench.begin()
    bench.end(scans=3)
    bench.scan()
    bench.scan()
    ros.until(lambda: len(bench.backend.taken) == 2)
    assert not out.exists()
    assert not bench.app.done
    bench.scan()
    ros.until(lambda: bench.app.done)
    assert len(read_map(out).cloud) == 150
    ros.until(lambda: bench.taken("/odometry/end") == 1)


def test_path_map_origin_and_frames_are_published_in_the_local_frame(ros: Any, tmp_path: Path) -> None:
    from subiaco_mapping.preprocessing.conversions import cloud_array
    from subiaco_ros.local_frame import earth_from_enu

    bench = Bench(ros, FakeBackend(), output_directory=str(tmp_path / "map"), preview_points=60)
    bench.begin()
    for _ in range(2):
        bench.scan()
    bench.end()
    ros.until(lambda: bench.paths and bench.points and bench.origins and len(bench.static) >= 2)
    assert len(bench.paths[0].poses) == 2
    assert bench.paths[0].header.frame_id == "map"
    preview = cloud_array(bench.points[0])
    assert len(preview) == 60
    assert np.abs(preview["x"]).max() <= 20.01
    expected = bench.backend.taken[0][1].xyz[0]
    np.testing.assert_allclose([preview[n][0] for n in "xyz"], expected, atol=1e-3)
    assert bench.origins[0].latitude == pytest.approx(-31.948, abs=1e-9)
    joined = {
        (t.header.frame_id, t.child_frame_id): t for m in [*bench.static, *bench.tf] for t in m.transforms
    }
    assert ("map", "odom") in joined
    earth = joined["earth", "map"].transform.translation
    np.testing.assert_allclose([earth.x, earth.y, earth.z], earth_from_enu(ENU)[:3, 3])


def test_map_to_odom_comes_with_every_scan_of_a_replay_and_changes_with_the_solution(ros: Any) -> None:
    bench = Bench(ros, FakeBackend())
    bench.begin()
    for _ in range(3):
        bench.scan()
    ros.until(lambda: len(bench.tf) == 3)
    moving = [t for m in bench.tf for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in moving} == {("map", "odom")}
    stamps = [pose.stamp_ns for pose, _ in bench.backend.taken]
    assert [t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in moving] == stamps
    assert all(t.transform.rotation.w == 1.0 and t.transform.translation.x == 0.0 for t in moving)
    bench.backend.T_local_odom[:3, 3] = [4.0, 0.0, 0.0]
    bench.app._publish_solution(bench.backend.optimize())
    bench.scan()
    ros.until(lambda: len(bench.tf) == 5)
    assert [m.transforms[0].transform.translation.x for m in bench.tf[3:]] == [4.0, 4.0]


def test_facts_of_the_front_end_reach_the_manifest(ros: Any) -> None:
    from std_msgs.msg import String

    bench = Bench(ros, FakeBackend())
    bench.begin()
    bench.out["facts"].publish(String(data=json.dumps({"packets": {"lost": 7}})))
    ros.until(lambda: bench.backend.facts)
    assert bench.backend.facts == {"packets": {"lost": 7}}


def test_each_sequence_is_started_under_its_name_once_the_one_before_is_complete(ros: Any) -> None:
    bench = Bench(ros, FakeBackend())
    bench.begin("one")
    bench.scan()
    bench.begin("two")
    bench.scan()
    ros.until(lambda: len(bench.backend.taken) == 2)
    assert [name for name, _ in bench.backend.sequences] == ["one", "two"]


def test_fixes_without_a_lever_arm_are_bad_input(ros: Any) -> None:
    from sensor_msgs.msg import NavSatFix

    bench = Bench(ros, FakeBackend(), sensors__gnss_frame="elsewhere")
    bench.begin()
    bench.out["fix"].publish(NavSatFix())
    with pytest.raises(InputError, match="elsewhere"):
        ros.until(lambda: bench.backend.fixes)


def test_without_a_replay_the_data_itself_starts_a_sequence(ros: Any, tmp_path: Path) -> None:
    from subiaco_msgs.srv import SaveMap

    bench = Bench(ros, FakeBackend(), **PLACES)
    bench.scan()
    bench.scan()
    ros.until(lambda: len(bench.backend.taken) == 2)
    assert [name for name, _ in bench.backend.sequences] == ["live"]
    request = SaveMap.Request(directory=str(tmp_path / "map"))
    assert call(ros, bench.user, SaveMap, "pose_graph/save_map", request).success
    assert len(read_map(tmp_path / "map").cloud) == 100


def test_on_live_topics_path_and_map_grow_and_an_interrupted_survey_leaves_its_map(
    ros: Any, tmp_path: Path
) -> None:
    parameters = {"live_period": 0.2, "save_on_exit": True, "output_directory": str(tmp_path / "map")}
    bench = Bench(ros, FakeBackend(), **PLACES, **parameters)
    bench.scan()
    ros.until(lambda: bench.paths and bench.points)
    bench.scan()
    ros.until(lambda: len(bench.paths[-1].poses) == 2)
    assert len(bench.paths) >= 2
    assert not (tmp_path / "map").exists()
    bench.app.close()
    assert len(read_map(tmp_path / "map").cloud) == 100
    bench.app.close()  # once is enough


def test_a_node_that_stays_is_given_a_second_replay(ros: Any) -> None:
    bench = Bench(ros, FakeBackend())
    for turn, name in enumerate(("one", "two"), start=1):
        bench.begin(name)
        bench.scan()
        bench.end()
        ros.until(lambda turn=turn: bench.taken("/odometry/end") == turn and bench.app._finished)
    assert [found for found, _ in bench.backend.sequences] == ["one", "two"]
    assert len(bench.backend.taken) == 2


def test_what_a_looped_bag_brings_again_enters_the_map_once(
    ros: Any, caplog: pytest.LogCaptureFixture
) -> None:
    from sensor_msgs.msg import NavSatFix

    from subiaco_ros.messages import stamp_message

    bench = Bench(ros, FakeBackend(), **PLACES)
    for turn in range(2):
        bench.sent = 0
        for k in range(3):
            fix = NavSatFix()
            fix.header.stamp = stamp_message(T0_NS + k)
            bench.out["fix"].publish(fix)
            bench.scan()
        ros.until(lambda turn=turn: bench.taken("/points_sky") == 3 * (turn + 1) == bench.taken("/gnss/fix"))
    assert [pose.stamp_ns for pose, _ in bench.backend.taken] == [T0_NS + k * 100_000_000 for k in (1, 2, 3)]
    assert len(bench.backend.fixes) == 3
    bench.scan()  # newer than all
    ros.until(lambda: len(bench.backend.taken) == 4)
    assert caplog.text.count("/odometry: time went back by 0.2 s") == 1
    arrivals = bench.app._arrivals.facts()
    assert (arrivals["/odometry"]["left_out"], arrivals["/gnss/fix"]["left_out"]) == (3, 3)


def call(ros: Any, user: Any, kind: Any, name: str, request: Any) -> Any:
    client = user.create_client(kind, name)
    ros.until(client.service_is_ready)
    future = client.call_async(request)
    ros.until(future.done)
    return future.result()


def test_the_services_optimise_and_save_and_say_why_not(ros: Any, tmp_path: Path) -> None:
    from subiaco_msgs.srv import Optimize, SaveMap

    bench = Bench(ros, FakeBackend(None))
    empty = call(ros, bench.user, Optimize, "pose_graph/optimize", Optimize.Request())
    assert (empty.success, empty.message) == (False, "no scan")
    bench.begin()
    bench.scan()
    ros.until(lambda: bench.backend.taken)
    solved = call(ros, bench.user, Optimize, "pose_graph/optimize", Optimize.Request())
    assert (solved.success, solved.poses) == (True, 1)
    request = SaveMap.Request(directory=str(tmp_path / "map"))
    assert call(ros, bench.user, SaveMap, "pose_graph/save_map", request).success
    assert read_map(tmp_path / "map").cloud.crs is None
    again = call(ros, bench.user, SaveMap, "pose_graph/save_map", request)
    assert not again.success
    assert "exists already" in again.message

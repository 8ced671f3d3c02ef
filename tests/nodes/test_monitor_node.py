"""The monitor node: what drivers send, what /diagnostics says, what lies on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

pytestmark = pytest.mark.ros

T0_NS = 1_760_000_000_000_000_000


class Bench:
    """A monitor with a clock of the test's own, and a tester that plays drivers."""

    def __init__(self, ros: Any, folder: Path | None = None, **parameters: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from std_msgs.msg import String

        from subiaco_mapping.config import MappingConfig
        from subiaco_mapping.health_monitor.files import SurveyFiles
        from subiaco_mapping.health_monitor.monitor import Monitor
        from subiaco_mapping.nodes.monitor_node import MonitorApp, MonitorParameters
        from subiaco_ros.parameters import read_models

        self.ros = ros
        self.now_ns = T0_NS
        node = ros.node("monitor", **parameters)
        own, config = read_models(node, MonitorParameters, MappingConfig)
        self.monitor = Monitor(config)
        files = None if folder is None else SurveyFiles(folder, "live", [])
        self.free = 500e9
        self.app = MonitorApp(
            node, own, self.monitor, files, lambda: (self.now_ns, self.now_ns), lambda: self.free
        )
        ros.apps.append(self.app)
        self.user = ros.node("tester")
        self.said = ros.collect(self.user, DiagnosticArray, "diagnostics", latched=False)
        self.streets = ros.collect(self.user, String, "quality/geojson")

    def publisher(self, kind: Any, topic: str, best_effort: bool = False) -> Any:
        from rclpy.qos import qos_profile_sensor_data

        from subiaco_ros.qos import reliable

        made = self.user.create_publisher(
            kind, topic, qos_profile_sensor_data if best_effort else reliable(100)
        )
        self.ros.until(made.get_subscription_count)
        return made

    def latest(self, name: str) -> Any:
        found = [s for array in self.said for s in array.status if s.name == f"monitor: {name}"]
        return found[-1] if found else None


def stamp(time_ns: int) -> Any:
    from builtin_interfaces.msg import Time

    return Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def fix(bench: Bench, status: int, sigma: float, north: float = 0.0) -> Any:
    from sensor_msgs.msg import NavSatFix

    message = NavSatFix(latitude=-31.95 + north / 111_000, longitude=115.83, altitude=20.0)
    message.header.stamp = stamp(bench.now_ns)
    message.status.status = status
    message.position_covariance = [sigma**2, 0.0, 0.0, 0.0, sigma**2, 0.0, 0.0, 0.0, sigma**2]
    message.position_covariance_type = 2
    return message


def test_a_gnss_driver_that_dies_is_on_diagnostics_and_in_the_manifest(ros: Any, tmp_path: Path) -> None:
    from sensor_msgs.msg import NavSatFix

    bench = Bench(ros, tmp_path / "survey")
    gnss = bench.publisher(NavSatFix, "gnss/fix")
    for k in range(10):
        bench.now_ns += 200_000_000
        gnss.publish(fix(bench, 2, 0.014, north=4.0 * k))
        ros.until(lambda count=k + 1: bench.monitor.streams["gnss"].count == count)
    ros.until(lambda: bench.latest("gnss") and bench.latest("gnss").level == b"\x00")
    assert {v.key: v.value for v in bench.latest("gnss").values}["state"] == "rtk fixed"
    bench.now_ns += 2_000_000_000
    ros.until(lambda: bench.latest("gnss").level == b"\x02")
    assert "gnss_silent: since 2.0 s" in bench.latest("gnss").message
    bench.app.close()
    manifest = yaml.safe_load((tmp_path / "survey" / "manifest.yaml").read_text())
    assert "gnss_silent" in manifest["sequences"]["live"]["flagged"]
    features = json.loads((tmp_path / "survey" / "quality.geojson").read_text())["features"]
    assert features[0]["properties"]["light"] == "green"


def test_best_effort_packets_are_taken_and_said(ros: Any) -> None:
    from ouster_sensor_msgs.msg import PacketMsg

    bench = Bench(ros)
    packets = bench.publisher(PacketMsg, "ouster/lidar_packets", best_effort=True)
    packets.publish(PacketMsg(buf=b"12345678"))
    ros.until(lambda: bench.monitor.streams["lidar"].count)
    ros.until(lambda: bench.latest("lidar") and "best_effort" in bench.latest("lidar").message)


def test_topics_of_other_names_come_by_remapping_and_their_status_by_the_driver_profile(ros: Any) -> None:
    from sensor_msgs.msg import NavSatFix

    bench = Bench(ros, gnss__driver="ublox")
    gnss = bench.publisher(NavSatFix, "gnss/fix")
    gnss.publish(fix(bench, 0, 0.4))  # carrier phase float, as ublox_gps says it
    ros.until(lambda: bench.monitor.gnss.last is not None)
    assert bench.monitor.gnss.state == "float"


def test_a_driver_that_reports_its_lock_on_diagnostics_is_heard(ros: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    bench = Bench(ros)
    driver = bench.publisher(DiagnosticArray, "diagnostics")
    ros.until(lambda: driver.get_subscription_count() == 2)  # the tester listens too
    status = DiagnosticStatus(name="ouster: Sync Pulse In", level=DiagnosticStatus.ERROR, message="unlocked")
    driver.publish(DiagnosticArray(status=[status]))
    ros.until(lambda: "pps_lost" in {s.name for s in bench.monitor.flags.raised()})


def test_a_recorder_of_another_namespace_is_not_that_of_the_monitor(ros: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    bench = Bench(ros, namespace="left")
    recorders = bench.publisher(DiagnosticArray, "diagnostics")
    ros.until(lambda: recorders.get_subscription_count() == 2)

    def says(name: str, level: bytes) -> None:
        status = DiagnosticStatus(name=f"{name}recorder: recording", level=level, message=name)
        marker = DiagnosticStatus(name="pps", level=level)  # what comes after it has been read too
        recorders.publish(DiagnosticArray(status=[status, marker]))

    def raised() -> set[str]:
        return {stretch.name for stretch in bench.monitor.flags.raised()}

    says("right/", DiagnosticStatus.ERROR)
    ros.until(lambda: "pps_lost" in raised())
    assert "not_recorded" not in raised()
    says("left/", DiagnosticStatus.ERROR)
    ros.until(lambda: "not_recorded" in raised())
    says("", DiagnosticStatus.OK)  # one that records for all
    ros.until(lambda: "not_recorded" not in raised())


def test_a_cloud_where_packets_belong_is_said(ros: Any) -> None:
    from sensor_msgs.msg import PointCloud2

    bench = Bench(ros)
    wrong = bench.user.create_publisher(PointCloud2, "gnss/fix", 1)
    subscription = bench.app._subscriptions["/gnss/fix"]
    ros.until(lambda: subscription.wrong_type)
    assert "sensor_msgs/msg/PointCloud2, expected sensor_msgs/msg/NavSatFix" in subscription.wrong_type
    assert wrong.get_subscription_count() == 0


def test_street_lights_are_lines_in_the_map_once_its_origin_is_known(ros: Any) -> None:
    from sensor_msgs.msg import NavSatFix
    from visualization_msgs.msg import Marker, MarkerArray

    from subiaco_ros.qos import latched

    bench = Bench(ros)
    shown = ros.collect(bench.user, MarkerArray, "quality/markers")
    origin = bench.user.create_publisher(NavSatFix, "map/origin", latched(1))
    origin.publish(NavSatFix(latitude=-31.95, longitude=115.83, altitude=20.0))
    gnss = bench.publisher(NavSatFix, "gnss/fix")
    for k in range(15):  # north along the street
        bench.now_ns += 200_000_000
        gnss.publish(fix(bench, 2, 0.014, north=4.0 * k))
        ros.until(lambda count=k + 1: bench.monitor.streams["gnss"].count == count)
    ros.until(lambda: shown and shown[-1].markers[0].points)
    (marker,) = shown[-1].markers
    assert (marker.header.frame_id, marker.ns, marker.type) == ("map", "streets", Marker.LINE_LIST)
    assert len(marker.points) == len(marker.colors)
    assert len(marker.points) % 2 == 0
    north = [point.y for point in marker.points]
    assert min(north) == pytest.approx(0.0, abs=1.0)
    assert 20.0 < max(north) < 60.0
    assert max(abs(point.x) for point in marker.points) < 0.1
    assert all(colour.g > colour.r for colour in marker.colors)  # green: nothing was wrong


def test_a_monitor_that_was_restarted_goes_on_with_what_it_wrote(ros: Any, tmp_path: Path) -> None:
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.health_monitor.files import SurveyFiles
    from subiaco_mapping.health_monitor.monitor import Monitor

    bench = Bench(ros, tmp_path)
    bench.monitor.on_points(bench.now_ns, bench.now_ns, bench.now_ns)
    bench.monitor.flags.event("clock_step", bench.now_ns, "jumped", "lidar")
    bench.app.close()
    later = Monitor(MappingConfig())
    later.on_points(T0_NS + 10**10, T0_NS + 10**10, T0_NS + 10**10)
    later.flags.event("clock_step", T0_NS + 10**10, "jumped again", "lidar")
    manifest = SurveyFiles(tmp_path, "live", []).manifest(later)["sequences"]["live"]
    assert [entry["detail"] for entry in manifest["flagged"]["clock_step"]] == ["jumped", "jumped again"]
    assert manifest["start_s"] == T0_NS * 1e-9


def test_a_looped_bag_goes_on_from_its_end_and_nothing_is_timed_before_the_clock_runs(
    ros: Any, tmp_path: Path
) -> None:
    from rclpy.parameter import Parameter
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import Imu

    from subiaco_mapping.nodes.monitor_node import build
    from subiaco_ros.messages import stamp_message

    node = ros.node("monitor", use_sim_time=True, output_directory=str(tmp_path))
    assert node.get_parameter("use_sim_time").type_ == Parameter.Type.BOOL
    app = build(node)
    ros.apps.append(app)
    user = ros.node("player")
    clock = user.create_publisher(Clock, "/clock", 10)
    imu = user.create_publisher(Imu, "/imu/data", 100)
    ros.until(lambda: clock.get_subscription_count() and imu.get_subscription_count())
    imu.publish(Imu())
    for _ in range(10):
        ros.executor.spin_once(timeout_sec=0.02)
    assert app._monitor.start_ns is None
    said = []
    for second in (100.0, 101.0, 102.0, 100.5, 101.5):  # played again from 100.5 on
        clock.publish(Clock(clock=stamp_message(round(second * 1e9))))
        expected = node.get_clock()
        ros.until(lambda second=second, expected=expected: expected.now().nanoseconds == round(second * 1e9))
        said.append(app._times()[0] * 1e-9)
        imu.publish(Imu())
        count = app._monitor.streams["imu"].count
        ros.until(lambda count=count: app._monitor.streams["imu"].count == count + 1)
    assert said == [100.0, 101.0, 102.0, 102.0, 103.0]
    assert app._monitor.start_ns == 100 * 10**9
    assert app._monitor.streams["imu"].longest_gap_ns <= 1_000_000_000

"""Every fault of a drive is noticed within two seconds, named, survived, and in the manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from streams import START_NS, Drive, watched

from subiaco_geo.errors import InputError
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.monitor import Monitor
from subiaco_mapping.health_monitor.routes import read_route

NOTICED = 2.0  # seconds


def stretches(monitor: Monitor, name: str) -> list[dict[str, Any]]:
    """Return the stretches of a flag as the manifest, written and read again, has them."""
    text = yaml.safe_dump(monitor.manifest("drive"))
    return list(yaml.safe_load(text)["sequences"]["drive"]["flagged"].get(name, []))


def after_start(entry: dict[str, Any], key: str = "start_s") -> float:
    return float(entry[key]) - START_NS * 1e-9


def test_a_sound_drive_raises_nothing() -> None:
    monitor, first = watched(Drive(duration=30.0))
    assert first == {}
    manifest = monitor.manifest("drive")["sequences"]["drive"]
    assert manifest["scans"] == 300
    assert manifest["length_m"] == pytest.approx(8.0 * 29.9, abs=0.1)
    assert manifest["gnss"]["states"] == {"rtk fixed": {"received": 150}}
    assert manifest["streams"]["imu"]["usual_rate_hz"] == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize(("sensor", "flag"), [("lidar", "lidar_silent"), ("imu", "imu_silent")])
def test_a_cable_pulled_for_ten_seconds_is_noticed_at_once_and_survived(sensor: str, flag: str) -> None:
    monitor, first = watched(Drive(duration=30.0, muted={sensor: [(10.0, 20.0)]}))
    assert 10.0 < first[flag] < 10.0 + NOTICED
    (entry,) = stretches(monitor, flag)
    assert after_start(entry) == pytest.approx(
        10.0, abs=0.2
    )  # since the last message, not since it was noticed
    assert after_start(entry, "end_s") == pytest.approx(20.0, abs=0.2)
    assert monitor.flags.raised() == []


def test_a_gnss_driver_that_dies_is_noticed_within_two_seconds_and_its_missing_fixes_too() -> None:
    monitor, first = watched(Drive(muted={"gnss": [(8.0, 99.0)]}))
    assert 8.0 < first["gnss_silent"] < 8.0 + NOTICED
    assert first["without_rtk_fixed"] < 8.0 + 2 * NOTICED
    (entry,) = stretches(monitor, "gnss_silent")
    assert after_start(entry) == pytest.approx(7.86, abs=0.1)
    assert after_start(entry, "end_s") == pytest.approx(20.0, abs=0.2)  # it lasts to the end


@pytest.mark.parametrize("size", [-1.0, 0.2, 37.0])
def test_a_lidar_clock_that_steps_is_named_with_its_size(size: float) -> None:
    monitor, first = watched(Drive(lidar_clock=lambda s: size if s >= 9.0 else 0.0))
    assert 9.0 <= first["clock_step"] < 9.0 + NOTICED
    (entry,) = stretches(monitor, "clock_step")
    assert entry["source"] == "lidar"
    assert float(entry["detail"].split()[2]) == pytest.approx(size, abs=0.01)


@pytest.mark.parametrize("size", [-3.0, 0.5])
def test_a_host_clock_that_steps_is_told_from_the_sensors(size: float) -> None:
    monitor, first = watched(Drive(host_clock=lambda s: size if s >= 9.0 else 0.0))
    assert 9.0 <= first["clock_step"] < 9.0 + NOTICED
    assert {entry["source"] for entry in stretches(monitor, "clock_step")} == {"host"}
    assert "lidar_silent" not in first  # a jump of the host's clock is not a silence


def test_first_messages_that_waited_for_a_listener_are_no_step() -> None:
    """They come in one go, a sensor that has just been found: later ones do not wait."""
    monitor = Monitor(MappingConfig())
    for k in range(30):
        stamp = START_NS + k * 200_000_000
        now = max(stamp, START_NS + 500_000_000) + 1_000_000
        monitor.on_points(stamp, now, now)
    monitor.tick(START_NS + 7 * 10**9)
    assert stretches(monitor, "clock_step") == []


def test_the_end_of_the_time_reference_is_a_lost_pps() -> None:
    monitor, first = watched(Drive(muted={"pps": [(6.0, 12.0)]}))
    assert 6.0 < first["pps_lost"] < 6.0 + NOTICED
    (entry,) = stretches(monitor, "pps_lost")
    assert after_start(entry) == pytest.approx(5.0, abs=0.01)
    assert after_start(entry, "end_s") == pytest.approx(12.0, abs=0.2)


def test_a_driver_that_says_it_lost_its_lock_is_believed() -> None:
    monitor = Monitor(MappingConfig())
    Drive(duration=3.0, pps=False).run(monitor)
    now = START_NS + 3 * 10**9
    monitor.on_pps_lock(False, "sync pulse: not locked", now)
    assert [s.name for s in monitor.flags.raised()] == ["pps_lost"]
    monitor.on_pps_lock(True, "", now + 10**8)
    assert monitor.flags.raised() == []


@pytest.mark.parametrize("rate", [1e-3, -1e-4])
def test_without_a_time_reference_a_lost_pps_shows_once_the_clock_has_run_away(rate: float) -> None:
    lost_at = 15.0
    drive = Drive(duration=75.0, pps=False, lidar_clock=lambda s: max(s - lost_at, 0.0) * rate)
    monitor, first = watched(drive)
    limit = monitor.config.watch.clocks.max_drift / abs(rate)  # seconds until that much has come together
    assert lost_at + limit < first["clock_drift"] < lost_at + limit + 8.0
    assert {entry["source"] for entry in stretches(monitor, "clock_drift")} == {"lidar"}


def test_a_host_clock_that_drifts_is_nobodys_fault() -> None:
    _, first = watched(Drive(duration=40.0, host_clock=lambda s: 1e-3 * s))
    assert "clock_drift" not in first
    assert "clock_step" not in first


def test_stamps_since_switching_on_are_no_utc_and_a_sensor_an_hour_off_disagrees() -> None:
    monitor, first = watched(Drive(duration=5.0, imu_clock=lambda _s: -START_NS * 1e-9 + 100.0))
    assert first["not_utc"] < NOTICED
    assert {entry["source"] for entry in stretches(monitor, "not_utc")} == {"imu"}
    _, first = watched(Drive(duration=5.0, gnss_clock=lambda _s: 3600.0))
    assert first["clock_disagreement"] < NOTICED
    assert first["clock_offset"] < NOTICED


def test_packets_that_never_arrived_are_counted_and_a_burst_of_losses_flagged() -> None:
    lost = {turn * 32 + k for turn in range(60, 70) for k in (3, 4, 20)}
    monitor, first = watched(Drive(duration=12.0, packets=True, drop=lost.__contains__))
    assert monitor.packets is not None
    assert monitor.packets.lost == len(lost)
    assert 6.0 < first["packet_loss"] < 6.0 + NOTICED
    (entry,) = stretches(monitor, "packet_loss")
    assert after_start(entry, "end_s") == pytest.approx(8.0, abs=0.3)
    assert monitor.manifest("d")["sequences"]["d"]["packets"]["packets"] == 12 * 10 * 32 - len(lost)


def test_a_cable_pulled_on_packets_counts_every_packet_that_the_sensor_sent_meanwhile() -> None:
    monitor, first = watched(Drive(duration=18.0, packets=True, muted={"lidar": [(5.0, 15.0)]}))
    assert first["lidar_silent"] < 5.0 + NOTICED
    assert monitor.packets is not None
    assert monitor.packets.lost == 100 * 32
    assert monitor.flags.scans == 80


def test_the_fall_from_fixed_is_flagged_once_it_lasts() -> None:
    monitor, first = watched(Drive(status=lambda s: 1 if 5 <= s < 5.8 or 9 <= s < 14 else 2))
    assert 10.8 <= first["without_rtk_fixed"] < 9.0 + 2.0 + 0.4  # the limit is two seconds itself
    (entry,) = stretches(monitor, "without_rtk_fixed")
    assert entry["detail"] == "float"
    assert after_start(entry, "end_s") == pytest.approx(14.06, abs=0.3)


def test_poor_geometry_is_flagged_by_dop_or_by_the_stated_sigma() -> None:
    _, first = watched(Drive(duration=3.0, sigma=0.4))
    assert first["poor_dop"] < 0.5
    monitor = Monitor(MappingConfig())
    Drive(duration=1.0).run(monitor)
    monitor.on_dop(4.2, 6.0, START_NS + 10**9)
    monitor.tick(START_NS + 10**9)
    assert [s.detail for s in monitor.flags.raised()] == ["HDOP 4.2"]


@pytest.mark.parametrize(
    ("accel", "word"),
    [
        (np.array([0.0, 0.0, np.nan]), "not finite"),
        (np.array([0.0, 0.0, 1.001]), "in g"),
        (np.array([0.1, 0.0, 0.0]), "gravity is missing"),
        (np.array([0.0, 0.0, 14.0]), "not gravity"),
    ],
)
def test_an_imu_that_cannot_be_is_named(accel: np.ndarray, word: str) -> None:
    monitor, first = watched(Drive(duration=4.0, accel=lambda _s: accel))
    assert first["imu_bad"] < NOTICED
    assert word in stretches(monitor, "imu_bad")[0]["detail"]


def test_an_imu_that_repeats_itself_is_stuck() -> None:
    from subiaco_mapping.measurements import ImuSample

    monitor = Monitor(MappingConfig())
    gyro, accel = np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.0, 9.81])
    for k in range(100):
        now = START_NS + k * 10_000_000
        monitor.on_imu(ImuSample(now, gyro, accel), now, now)
    assert "stuck" in stretches(monitor, "imu_bad")[0]["detail"]


def test_a_disk_that_fills_is_low_then_full() -> None:
    monitor = Monitor(MappingConfig())
    levels = []
    for k in range(30):
        monitor.on_disk((30.0 - k) * 1e9, START_NS + k * 10**9)
        levels.append({s.name for s in monitor.flags.raised()})
    assert levels[0] == set()
    assert levels[6] == {"disk_low"}  # at this rate it lasts minutes
    assert levels[29] == {"disk_full"}
    (entry,) = stretches(monitor, "disk_full")
    assert after_start(entry) == pytest.approx(29.0)


def test_a_stream_that_thins_out_is_slow_but_not_silent() -> None:
    monitor = Monitor(MappingConfig())
    for k in range(1000):
        if k < 600 or k % 2 == 0:
            now = START_NS + k * 10_000_000
            monitor.on_points(now, now, now)
    assert [s.name for s in monitor.flags.raised()] == ["lidar_slow"]
    assert monitor.flags.raised()[0].detail == "50 of 100 Hz"


def test_stretches_near_one_another_are_one() -> None:
    monitor, _ = watched(Drive(duration=20.0, muted={"imu": [(5.0, 6.0), (7.0, 8.0), (15.0, 16.0)]}))
    spans = [(after_start(e), after_start(e, "end_s")) for e in stretches(monitor, "imu_silent")]
    np.testing.assert_allclose(spans, [(5.0, 8.0), (15.0, 16.0)], atol=0.1)


def test_the_manifest_says_what_each_flag_means() -> None:
    monitor, _ = watched(Drive(muted={"gnss": [(8.0, 99.0)]}))
    manifest = monitor.manifest("drive")
    assert manifest["sequences"]["drive"]["flagged"].keys() <= manifest["legend"].keys()


def test_where_a_player_decides_when_messages_arrive_no_clock_is_accused() -> None:
    late = Drive(duration=20.0, host_clock=lambda s: 3.0 if s >= 9.0 else 0.0)
    played, _ = watched(late, host_clock=False)
    judged, _ = watched(late)
    assert stretches(judged, "clock_step")
    assert played.flags.flagged(played.now_ns) == {}


@pytest.mark.parametrize("text", ["", "street,number\nHay,1\n", "lat,lon\nhere,there\n"])
def test_a_table_that_holds_no_route_is_named_with_the_columns_that_it_needs(
    tmp_path: Path, text: str
) -> None:
    (tmp_path / "route.csv").write_text(text)
    with pytest.raises(InputError, match=r"route.csv: holds no route; give .* columns lat,lon in degrees"):
        read_route(tmp_path / "route.csv")

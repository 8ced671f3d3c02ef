"""CSV logs beside a capture, and OSF files, into bags."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.bags import TYPESTORE, BagReader
from subiaco_geo.errors import InputError
from subiaco_geo.topics import FIX, HEADING, IMU, LIDAR_PACKETS, METADATA
from subiaco_mapping.importers.csv_logs import (
    GnssColumns,
    LogsConfig,
    parse_time_ns,
    read_gnss_log,
    read_imu_log,
)
from subiaco_mapping.importers.packets import _refuse_other_times, import_recording, osf_recording
from subiaco_mapping.inspection.inspect_bag import inspect_bag
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.conversions import fix_from_msg, heading_from_msg, imu_from_msg

LOGS = LogsConfig()
GNSS = """utc,latitude,longitude,height,quality,sigma_east,sigma_north,sigma_up,heading,heading_sigma
2025-03-04T05:06:07.400Z,-31.95000001,115.83000002,12.345,4,0.011,0.012,0.02,90.0,0.3
2025-03-04T05:06:07.200Z,-31.95,115.83,12.3,5,0.4,0.4,0.7,,
2025-03-04T05:06:07.600Z,,,,0,,,,,
"""
IMU_LOG = """utc, gyro_x, gyro_y, gyro_z, accel_x, accel_y, accel_z
1741064767.213700001,0.01,-0.02,0.3,0.1,0.2,9.8
"""


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_fixes_and_headings_keep_their_numbers_and_come_in_time_order(tmp_path: Path) -> None:
    found = read_gnss_log(written(tmp_path, "gnss.csv", GNSS), LOGS)
    assert [m.topic for m in found] == [FIX, FIX, HEADING, FIX]
    assert np.all(np.diff([m.time_ns for m in found]) >= 0)
    messages = [
        TYPESTORE.deserialize_cdr(m.cdr, "sensor_msgs/msg/NavSatFix") for m in found if m.topic == FIX
    ]
    fixes = [fix_from_msg(message, GnssConfig()) for message in messages]
    assert [fix.status for fix in fixes] == [1, 2, -1]
    assert (fixes[1].latitude, fixes[1].longitude, fixes[1].altitude) == (-31.95000001, 115.83000002, 12.345)
    np.testing.assert_allclose(np.diag(fixes[1].covariance), np.array([0.011, 0.012, 0.02]) ** 2)
    assert fixes[1].time_ns == parse_time_ns("2025-03-04 05:06:07.4")
    assert not fixes[2].is_usable()
    heading = heading_from_msg(TYPESTORE.deserialize_cdr(found[2].cdr, "sensor_msgs/msg/Imu"))
    assert heading.yaw == pytest.approx(0.0, abs=1e-9), "east is 90 degrees from north"
    assert heading.sigma == pytest.approx(np.radians(0.3))


def test_imu_samples_keep_their_numbers_and_nanoseconds(tmp_path: Path) -> None:
    (found,) = read_imu_log(written(tmp_path, "imu.csv", IMU_LOG), LOGS)
    sample = imu_from_msg(TYPESTORE.deserialize_cdr(found.cdr, "sensor_msgs/msg/Imu"))
    assert found.topic == IMU
    assert sample.time_ns == found.time_ns == 1_741_064_767_213_700_001
    np.testing.assert_array_equal(sample.gyro, [0.01, -0.02, 0.3])
    np.testing.assert_array_equal(sample.accel, [0.1, 0.2, 9.8])


def test_columns_of_other_names_are_taken_by_configuration(tmp_path: Path) -> None:
    config = LogsConfig(gnss=GnssColumns(latitude="lat"))
    log = written(tmp_path, "gnss.csv", GNSS.replace("latitude", "lat", 1))
    assert len(read_gnss_log(log, config)) == 4
    with pytest.raises(InputError, match=r"no column 'latitude' .*logs\.gnss\.FIELD"):
        read_gnss_log(log, LOGS)


@pytest.mark.parametrize(
    ("old", "new"), [(",4,0.011", ",four,0.011"), ("07.400Z", "07.4x"), ("12.345", "high")]
)
def test_a_line_that_cannot_be_read_is_named(tmp_path: Path, old: str, new: str) -> None:
    with pytest.raises(InputError, match=r"gnss\.csv: line 2: "):
        read_gnss_log(written(tmp_path, "gnss.csv", GNSS.replace(old, new, 1)), LOGS)


@given(st.integers(10**18, 2**31 * 10**9 - 1))
def test_times_are_read_to_the_nanosecond(time_ns: int) -> None:
    assert parse_time_ns(str(time_ns)) == time_ns
    assert parse_time_ns(f"{time_ns // 10**9}.{time_ns % 10**9:09d}") == time_ns


def test_a_capture_and_its_logs_are_merged_in_time_order(shared_data: Path, tmp_path: Path) -> None:
    recording = shared_data / "ouster" / "OS-0-32-U1_v2.2.0_1024x10.pcap"
    if not recording.is_file():
        pytest.skip(f"no capture: {recording}")
    import_recording(recording, tmp_path / "alone")
    with BagReader(tmp_path / "alone") as reader:
        middle_ns = (reader.start_ns + reader.end_ns) // 2
    text = GNSS.splitlines()[0] + f"\n{middle_ns},-31.95,115.83,12.3,4,0.01,0.01,0.02,10,\n"
    logged = read_gnss_log(written(tmp_path, "gnss.csv", text), LOGS)
    counts = import_recording(recording, tmp_path / "bag", logged=logged)
    assert counts[FIX] == counts[HEADING] == 1
    with BagReader(tmp_path / "bag") as reader:
        order = [(m.log_time_ns, m.topic) for m in reader.messages()]
    assert [t for t, _ in order] == sorted(t for t, _ in order)
    topics = [topic for _, topic in order]
    assert LIDAR_PACKETS in topics[: topics.index(FIX)]
    assert LIDAR_PACKETS in topics[topics.index(FIX) :]
    assert counts[LIDAR_PACKETS] == topics.count(LIDAR_PACKETS)


def test_a_log_of_another_time_is_refused_with_both_spans(tmp_path: Path) -> None:
    spans = {LIDAR_PACKETS: (0, 10 * 10**9), FIX: (86_400 * 10**9, 86_500 * 10**9)}
    with pytest.raises(InputError) as caught:
        _refuse_other_times(tmp_path / "drive.pcap", spans)
    said = str(caught.value)
    assert f"drive.pcap: {LIDAR_PACKETS} lasts from 1970-01-01T00:00:00Z to 1970-01-01T00:00:10Z" in said
    assert f"{FIX} from 1970-01-02T00:00:00Z to 1970-01-02T00:01:40Z; give the log of this drive" in said
    _refuse_other_times(tmp_path / "drive.pcap", spans | {FIX: (10_500_000_000, 20 * 10**9)})


def test_an_osf_file_gives_a_bag_that_decodes_without_loss(shared_data: Path, tmp_path: Path) -> None:
    recording = shared_data / "ouster" / "pose_delta_1_128.osf"
    if not recording.is_file():
        pytest.skip(f"no OSF file: {recording}")
    counts = import_recording(recording, tmp_path / "bag")
    assert counts[METADATA] == 1
    facts = inspect_bag(tmp_path / "bag")
    assert facts["lidar"]["scans"] >= 1
    assert facts["lidar"]["lost"] == 0
    assert facts["lidar"]["points_per_scan"] > 10_000


def test_a_file_that_only_bears_the_name_of_osf_is_refused(tmp_path: Path) -> None:
    recording = written(tmp_path, "drive.osf", "no scans here\n" * 20)
    with pytest.raises(InputError, match=r"drive\.osf: not a whole OSF file"):
        import_recording(recording, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize("fault", [MemoryError(), RuntimeError("bad magic\nat byte 4")])
def test_whatever_the_osf_library_raises_is_told_in_one_line(
    fault: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged file may claim more than any memory, and that error has no text."""

    def reader(_name: str) -> None:
        raise fault

    monkeypatch.setattr("subiaco_mapping.importers.packets.osf.Reader", reader)
    with pytest.raises(InputError, match=r"^drive\.osf: not a whole OSF file \((MemoryError|bad magic)\)"):
        list(osf_recording(Path("drive.osf")))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("drive.mcap", "needs no import"),
        ("drive/metadata.yaml", "needs no import"),
        ("drive.pos", "--gnss"),
        ("imu.csv", "--gnss or --imu"),
        ("drive.las", "not supported"),
        (
            "2011_09_26/2011_09_26_drive_0027_sync/velodyne_points/x",
            "for example .*2011_09_26_drive_0027_sync",
        ),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line_that_names_the_way(
    tmp_path: Path, name: str, said: str
) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")
    given = tmp_path / name.split("/", maxsplit=1)[0]
    with pytest.raises(InputError, match=said) as refused:
        import_recording(given, tmp_path / "bag")
    assert "\n" not in str(refused.value)
    assert str(given) in str(refused.value)

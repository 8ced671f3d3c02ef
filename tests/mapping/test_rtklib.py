"""RTKLIB solutions become fixes: its quality is not NMEA's, its time mostly not UTC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from subiaco_geo.bags import TYPESTORE
from subiaco_geo.errors import InputError
from subiaco_mapping.importers.csv_logs import LogsConfig, parse_time_ns, read_gnss_log
from subiaco_mapping.measurements import GnssFix
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.conversions import fix_from_msg

NAMES = (
    "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
)
NOTE = "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"
ROW = "-31.95000001 115.83000002 12.345 {q} 9 0.0200 0.0100 0.0300 -0.0050 0.0000 0.0000 0.00"


def fixes(folder: Path, *lines: str) -> list[GnssFix]:
    path = folder / "drive.pos"
    path.write_text("\n".join(lines) + "\n")
    found = read_gnss_log(path, LogsConfig())
    messages = [TYPESTORE.deserialize_cdr(m.cdr, "sensor_msgs/msg/NavSatFix") for m in found]
    return [fix_from_msg(message, GnssConfig()) for message in messages]


@pytest.mark.parametrize(("quality", "state"), [(1, 2), (2, 1), (3, 0), (4, 0), (5, 0), (6, 0), (0, -1)])
def test_one_is_fixed_and_two_is_float(tmp_path: Path, quality: int, state: int) -> None:
    (fix,) = fixes(tmp_path, NOTE, f"%  GPST {NAMES}", "2025/07/08 19:34:18.500 " + ROW.format(q=quality))
    assert fix.status == state
    assert (fix.latitude, fix.longitude, fix.altitude) == (-31.95000001, 115.83000002, 12.345)


@pytest.mark.parametrize(
    ("system", "stamp"),
    [
        ("GPST", "2025/07/08 19:34:18.500"),
        ("GPST", "2374 243258.500"),
        ("UTC", "2025/07/08 19:34:00.500"),
        ("JST", "2025/07/09 04:34:00.500"),
    ],
)
def test_times_of_every_system_become_utc(tmp_path: Path, system: str, stamp: str) -> None:
    (fix,) = fixes(tmp_path, f"%  {system} {NAMES}", f"{stamp} {ROW.format(q=1)}")
    assert fix.time_ns == parse_time_ns("2025-07-08T19:34:00.500Z")


def test_signed_standard_deviations_become_covariances(tmp_path: Path) -> None:
    (fix,) = fixes(tmp_path, f"%  GPST {NAMES}", "2025/07/08 19:34:18.5 " + ROW.format(q=1))
    expected = [[1e-4, -2.5e-5, 0], [-2.5e-5, 4e-4, 0], [0, 0, 9e-4]]
    np.testing.assert_allclose(fix.covariance, expected, atol=1e-12)


def test_commas_may_part_the_cells(tmp_path: Path) -> None:
    lines = f"%  GPST,{NAMES.replace(' ', ',')}", "2025/07/08,19:34:18.5," + ROW.format(q=2).replace(" ", ",")
    (fix,) = fixes(tmp_path, *lines)
    assert fix.status == 1


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["2025/07/08 19:34:18.5 1 2 3 1"], "no header"),
        (["%  GPST x-ecef(m) y-ecef(m) z-ecef(m) Q", "2025/07/08 19:34:18.5 1 2 3 1"], "no column latitude"),
        (["% (lat/lon/height=WGS84/geodetic,Q=1:fix)"], "ellipsoidal"),
        ([f"%  GPST {NAMES}", "2025/07/08 19:34:18.5 -31.9 115.8"], "line 2: 4 cells"),
        ([f"%  GPST {NAMES}", "2025/07/08 99:34:18.5 " + ROW.format(q=1)], "line 2"),
        ([f"%  GPST {NAMES}"], "no solution"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line(tmp_path: Path, lines: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        fixes(tmp_path, *lines)
    assert "drive.pos" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_real_drive_is_fixed_or_float_and_four_kilometres_long(shared_data: Path) -> None:
    path = shared_data / "rtk_imu_drive" / "gnss_1934_sf.pos"
    if not path.is_file():
        pytest.skip("no rtk_imu_drive among the real recordings")
    found = read_gnss_log(path, LogsConfig())
    messages = [TYPESTORE.deserialize_cdr(m.cdr, "sensor_msgs/msg/NavSatFix") for m in found]
    status = np.array([m.status.status for m in messages])
    assert (found[-1].time_ns - found[0].time_ns) * 1e-9 == pytest.approx(549, abs=2)
    assert set(status.tolist()) <= {0, 1, 2}
    assert (status == 2).mean() > 0.5
    place = np.radians([[m.latitude, m.longitude] for m in messages])
    steps = np.diff(place, axis=0) * [6.37e6, 6.37e6 * np.cos(place[0, 0])]
    assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(4040, rel=0.02)

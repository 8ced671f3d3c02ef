"""Readers that are fuzzed: clouds, bags, packets, texts, and (exchanged_targets.py) folders and logs."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import yaml
from exchanged_targets import EXCHANGED
from fuzz_cases import Target

# ---------------------------------------------------------------- clouds


def _small_cloud():
    from subiaco_geo.clouds import PointCloud

    rng = np.random.default_rng(4)
    xyz = rng.uniform(0, 30, (40, 3))
    fields = {"intensity": rng.integers(0, 900, 40).astype(np.uint16), "rho": rng.random(40).astype("f4")}
    return PointCloud(xyz, np.array([391_200.0, 6_464_300.0, 12.0]), "EPSG:7850", fields)


def _written(suffix: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        from subiaco_geo.cloud_io import write_cloud

        path = folder / f"seed{suffix}"
        write_cloud(path, _small_cloud())
        return [path.read_bytes()]

    return seeds


def _ply_seeds(folder: Path) -> list[bytes]:
    rows = "".join(f"{i}.5 {i * 2} 1.25 7\n" for i in range(12))
    text = (
        "ply\nformat ascii 1.0\ncomment crs EPSG:7850\nelement note 2\nproperty int a\nelement vertex 12\n"
        "property double x\nproperty double y\nproperty float z\nproperty uchar c\n"
        f"end_header\n1\n2\n{rows}"
    )
    return [*_written(".ply")(folder), text.encode()]


def _pcd_seeds(_folder: Path) -> list[bytes]:
    def head(form: str) -> bytes:
        return (
            "VERSION .7\nFIELDS x y z i\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 9\nHEIGHT 1\n"
            f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 9\nDATA {form}\n"
        ).encode()

    rows = [(k, 2.0 * k, 0.5, k) for k in range(9)]
    table = np.array(rows, dtype="<f4,<f4,<f4,<u2")
    columns = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
    packed = b"".join(bytes([len(run) - 1]) + run for run in re.findall(rb"(?s).{1,32}", columns))
    sizes = struct.pack("<II", len(packed), len(columns))
    text = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    return [
        head("ascii") + text,
        head("binary") + table.tobytes(),
        head("binary_compressed") + sizes + packed,
    ]


def _read_cloud(path: Path) -> object:
    from subiaco_geo.cloud_io import read_cloud

    return read_cloud(path)


# ---------------------------------------------------------------- packets and bags


@cache
def small_sensor() -> tuple[str, tuple[bytes, ...]]:
    """A sensor of 16 beams at 512x10, and the packets of two turns."""
    from ouster.sdk import core

    from subiaco_sim.config import LidarMode
    from subiaco_sim.packets import sensor_info

    info = sensor_info(LidarMode.COLUMNS_512, dual=True, beams=16)
    packets: list[bytes] = []
    for number in range(2):
        frame = core.LidarFrame(info)
        frame.frame_id = 65535 + number
        frame.timestamp[:] = 10**18 + number * 10**8 + np.arange(512) * (10**8 // 512)
        frame.measurement_id[:] = np.arange(512)
        frame.status[:] = 1
        frame.field("RANGE")[:] = 9000
        made = core.frame_to_packets(frame, core.PacketFormat(info), info.init_id, 0)
        packets += [bytes(packet.buf) for packet in made]
    return info.to_json_string(), tuple(packets)


def _read_packets(path: Path) -> object:
    """Decode what a file holds, cut at the size of a packet; the rest is a packet of its own."""
    from subiaco_mapping.preprocessing.config import DecodeConfig
    from subiaco_mapping.preprocessing.decode import PacketDecoder

    decoder = PacketDecoder(small_sensor()[0], DecodeConfig())
    data, size = path.read_bytes(), decoder.packet_size
    packets = [data[start : start + size] for start in range(0, len(data), size)]
    scans = [scan for packet in packets for scan in decoder.push(packet)] + decoder.flush()
    assert decoder.counts.packets == len(packets)
    assert all(np.isfinite(scan.first.xyz).all() for scan in scans)
    return scans


def _read_metadata(path: Path) -> object:
    from subiaco_mapping.preprocessing.config import DecodeConfig
    from subiaco_mapping.preprocessing.decode import PacketDecoder

    decoder = PacketDecoder(path.read_text(errors="replace"), DecodeConfig())
    for packet in small_sensor()[1][:3]:
        decoder.push(packet)
    return decoder.flush()


def _bag_seeds(folder: Path) -> list[bytes]:
    from subiaco_geo.bags import TYPESTORE, BagWriter
    from subiaco_geo.topics import FIX, MESSAGE_TYPES, METADATA

    types = TYPESTORE.types
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=10**9, nanosec=5), frame_id="gnss_link"
    )
    fix = types["sensor_msgs/msg/NavSatFix"](
        header=header, status=types["sensor_msgs/msg/NavSatStatus"](status=2, service=1), latitude=-31.9,
        longitude=115.8, altitude=20.0, position_covariance=np.eye(3).ravel(), position_covariance_type=2,
    )  # fmt: skip
    seeds = []
    for compress in (False, True):
        path = folder / f"seed{compress}"
        with BagWriter(path, compress=compress) as writer:
            text = types["std_msgs/msg/String"](data="{}")
            writer.write(METADATA, MESSAGE_TYPES[METADATA], text, 10**18, latched=True)
            for number in range(3):
                writer.write(FIX, MESSAGE_TYPES[FIX], fix, 10**18 + number)
        seeds.append(next(path.glob("*.mcap")).read_bytes())
    return seeds


def _read_bag(path: Path) -> object:
    from subiaco_geo.bags import BagReader

    with BagReader(path) as reader:
        return [reader.deserialize(message) for message in reader.messages()]


def _read_bag_folder(path: Path) -> object:
    """Read the seed's storage through a damaged ``metadata.yaml``."""
    folder = path.parent / "folder"
    if not folder.is_dir():
        (folder.parent / "seedTrue").rename(folder)
    (folder / "metadata.yaml").write_bytes(path.read_bytes())
    return _read_bag(folder)


def _metadata_yaml_seeds(folder: Path) -> list[bytes]:
    _bag_seeds(folder)
    return [(folder / "seedTrue" / "metadata.yaml").read_bytes()]


def _recover(path: Path) -> object:
    from subiaco_geo.bag_recovery import recover_bag

    target = path.with_name("whole.mcap")
    target.unlink(missing_ok=True)
    return recover_bag(path, target)


# ---------------------------------------------------------------- texts


def _read_config(path: Path) -> object:
    from subiaco_geo.config import load_config
    from subiaco_mapping.config import MappingConfig

    return load_config(MappingConfig, [path])


def _config_seeds(_folder: Path) -> list[bytes]:
    root = Path(__file__).resolve().parents[2] / "config"
    inside = {
        "odometry": {"voxel": 0.7},
        "crs": "EPSG:7850",
        "sensors": {"lidar": {"translation": [1, 0, 2]}},
    }
    small = yaml.safe_dump({"/**": {"ros__parameters": inside}}).encode()
    return [small, (root / "mapping.yaml").read_bytes(), (root / "drivers" / "ublox.yaml").read_bytes()]


def _setting(path: Path) -> object:
    from subiaco_geo.config import load_config
    from subiaco_mapping.config import MappingConfig

    return load_config(MappingConfig, settings=[" ".join(path.read_text(errors="replace").split())])


def _read_tum(path: Path) -> object:
    from subiaco_geo.trajectories import read_tum

    return read_tum(path)


def _read_path(path: Path) -> object:
    """Read a trajectory of another system, and bring it to a cloud along it."""
    from subiaco_geo.cloud_io import write_cloud
    from subiaco_geo.clouds import PointCloud
    from subiaco_geo.trajectory_files.reading import read_trajectory

    cloud = path.with_name("along.ply")
    if not cloud.is_file():
        xyz = np.column_stack([np.arange(50.0), np.zeros(50), np.full(50, -2.0)])
        write_cloud(cloud, PointCloud(xyz, np.array([391_200.0, 6_464_300.0, 12.0]), "EPSG:7850"))
    found = read_trajectory(path, cloud, "EPSG:7850").trajectory
    assert np.isfinite(found.poses).all()
    return found


def _sbet_seeds(_folder: Path) -> list[bytes]:
    rows = np.zeros((20, 17))
    rows[:, 0] = 345_600.0 + 0.05 * np.arange(20)
    rows[:, 1] = np.radians(-31.95) + 1e-8 * np.arange(20)
    rows[:, 2], rows[:, 3] = np.radians(115.85), 14.0
    rows[:, 10] = 0.3
    return [rows.astype("<f8").tobytes()]


def _read_kitti(path: Path) -> object:
    from subiaco_geo.trajectories import read_kitti

    path.with_suffix(".times.txt").write_text("".join(f"{k}.5\n" for k in range(5)))
    return read_kitti(path)


def _read_control(path: Path) -> object:
    from subiaco_mapping.control_points import read_control

    return read_control(path, "EPSG:7850", "EPSG:7850")


def _read_route(path: Path) -> object:
    from subiaco_mapping.health_monitor.routes import read_route

    return read_route(path)


def _read_table(path: Path) -> object:
    from subiaco_change.outputs.table import read_csv

    return read_csv(path)


def _table_seeds(_folder: Path) -> list[bytes]:
    from subiaco_change.outputs.table import COLUMNS

    named = {"class": "building", "label": "Added"}
    row = ",".join(named.get(name, "1") for name in COLUMNS)
    return [f"{','.join(COLUMNS)}\n{row}\n".encode()]


def _read_transform(path: Path) -> object:
    from subiaco_change.job import read_transform

    return read_transform(path)


def _text(*texts: str) -> Callable[[Path], list[bytes]]:
    return lambda _folder: [text.encode() for text in texts]


_TUM = "# a comment\n" + "".join(f"{k}.123456789 {k} 0.5 -1 0 0 0 1\n" for k in range(5))
_KITTI = "1 0 0 5 0 1 0 6 0 0 1 7\n" * 5
_POSES = (
    "time;latitude;longitude;height;roll;pitch;heading\n"
    + "".join(f"{k}.5;-31.95;115.85;14;0.1;0;{k}\n" for k in range(5)),
    "# t x y z qx qy qz qw\n" + "".join(f"{k},391200,6464300,14,0,0,0,1\n" for k in range(5)),
)
_CONTROL = (
    "name,east,north,height,map_east,map_north,map_height\np,391200,6464300,12.5,391200.1,6464300,\n" * 1
)
_ROUTE = (
    '{"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[115.8, -31.9], [115.9, -31.8]]}}'
)

TARGETS = (
    Target("packets", ".bin", _read_packets, lambda _folder: [b"".join(small_sensor()[1])]),
    Target(
        "sensor metadata",
        ".json",
        _read_metadata,
        lambda _folder: [small_sensor()[0].encode()],
        "/ouster/metadata",
    ),
    Target("bag", ".mcap", _read_bag, _bag_seeds),
    Target("bag metadata", ".yaml", _read_bag_folder, _metadata_yaml_seeds, named="folder"),
    Target("recovery", ".mcap.partial", _recover, _bag_seeds),
    Target("ply", ".ply", _read_cloud, _ply_seeds),
    Target("pcd", ".pcd", _read_cloud, _pcd_seeds),
    Target("las", ".las", _read_cloud, _written(".las")),
    Target("laz", ".laz", _read_cloud, _written(".laz")),
    Target("configuration", ".yaml", _read_config, _config_seeds),
    Target("setting", ".txt", _setting, _text("odometry.voxel=0.8", "crs=EPSG:7850"), named=""),
    Target("tum", ".tum", _read_tum, _text(_TUM)),
    Target("sbet", ".sbet", _read_path, _sbet_seeds),
    Target("table of poses", ".csv", _read_path, _text(*_POSES)),
    Target("kitti", ".txt", _read_kitti, _text(_KITTI)),
    Target("control", ".csv", _read_control, _text(_CONTROL)),
    Target("route", ".geojson", _read_route, _text(_ROUTE)),
    Target("route table", ".csv", _read_route, _text("lat,lon\n-31.9,115.8\n-31.8,115.9\n")),
    Target("change table", ".csv", _read_table, _table_seeds),
    Target("transform", ".txt", _read_transform, _text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")),
    *EXCHANGED,
)

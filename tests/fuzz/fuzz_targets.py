"""What is fuzzed: whole small inputs, how they are damaged, and readers that may only refuse.

A case is a seed file and a list of edits. A reader may return, or raise :class:`SubiacoError`; anything
else, more than :data:`CPU_SECONDS` of processor time or more than :data:`MEMORY` bytes above what the process
held before is a fault.
"""

from __future__ import annotations

import re
import resource
import signal
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import psutil
import yaml

from subiaco_geo.errors import SubiacoError

CPU_SECONDS = 10.0
MEMORY = 1 << 30
_WHOLE_NUMBERS = (0, 1, 0x7F, 0xFF, 0xFFFF, 2**31 - 1, 2**32 - 1, 10**9, 10**12, 2**63 - 1, 2**64 - 1)
_WORDS = (
    b"0", b"-1", b"1000000000000", b"99999999999999999999999", b"1e999", b"nan", b"-inf", b"1e-320", b"",
    b"\x00", b"\xff\xfe", b"[[[[", b"{", b"~", b"!!python/object/apply:os.getcwd []", b"&a [*a, *a]",
    b"2025-13-45", b"0x", b"1_0", b'"', b"\n", b"\r",
)  # fmt: skip
Edit = tuple[int, int, int]
KINDS = 10


def damaged(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Apply edits ``(kind, where, what)``; half of them fall into the first 400 bytes, where headers are."""
    for kind, where, what in edits:
        reach = len(data) if where & 1 else min(len(data), 400)
        at = (where >> 1) % (reach + 1)
        data = _EDITS[kind % KINDS](data, at, what)
    return data


def _put(data: bytes, at: int, piece: bytes) -> bytes:
    return data[:at] + piece + data[at + len(piece) :]


def _number(data: bytes, at: int, what: int) -> bytes:
    """Write an awkward whole number of 1, 2, 4 or 8 bytes."""
    size = (1, 2, 4, 8)[what % 4]
    value = _WHOLE_NUMBERS[what // 4 % len(_WHOLE_NUMBERS)] % (1 << 8 * size)
    return _put(data, at, value.to_bytes(size, "little"))


def _word(data: bytes, at: int, what: int) -> bytes:
    """Replace the next word or number of a text by an awkward one."""
    found = re.compile(rb"[\w.+-]+").search(data, at)
    start, end = found.span() if found else (at, at)
    return data[:start] + _WORDS[what % len(_WORDS)] + data[end:]


def _line(data: bytes, at: int, what: int) -> bytes:
    """Drop, double or move a line."""
    lines = data.split(b"\n")
    index = data[:at].count(b"\n")
    line = lines.pop(index)
    if what % 3:
        lines[index:index] = [line] * 2 if what % 3 == 1 else []
        lines[what // 3 % (len(lines) + 1) :][:0] = [line]
    return b"\n".join(lines)


_EDITS: tuple[Callable[[bytes, int, int], bytes], ...] = (
    lambda data, at, what: _put(data, at, bytes([data[at] ^ (1 << what % 8)])) if at < len(data) else data,
    lambda data, at, what: _put(data, at, bytes([what % 256])),
    _number,
    _number,
    _word,
    _word,
    _line,
    lambda data, at, what: data[:at],
    lambda data, at, what: data[:at] + data[at + what % 64 :],
    lambda data, at, what: data[:at] + data[at : at + what % 64] + data[at:],
)


class Fault(AssertionError):  # noqa: N818
    """A reader did what it must not."""


def _too_long(_signal: int, _frame: object) -> None:
    raise Fault(f"more than {CPU_SECONDS:g} s of processor time")


@contextmanager
def bounds() -> Iterator[None]:
    """Bound processor time and memory of what runs inside, native code too."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + MEMORY, hard))
    before = signal.signal(signal.SIGPROF, _too_long)
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@dataclass(frozen=True)
class Target:
    """A reader and the whole inputs that are damaged for it."""

    name: str
    suffix: str
    read: Callable[[Path], object]
    seeds: Callable[[Path], list[bytes]]


def run(target: Target, data: bytes, folder: Path) -> bool:
    """Read data within bounds and tell whether they were accepted.

    Raises
    ------
    Fault
        It crashed, hung, or took the memory.
    """
    path = folder / f"case{target.suffix}"
    path.write_bytes(data)
    try:
        with bounds():
            target.read(path)
    except SubiacoError as error:
        if "\n" in str(error) or len(str(error)) > 2000:
            raise Fault(f"the refusal is no single line: {str(error)[:300]!r}") from error
        return False
    except Fault:
        raise
    except Exception as error:
        raise Fault(f"{target.name}: {type(error).__name__}: {str(error)[:300]}") from error
    return True


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
def _sensor() -> tuple[str, tuple[bytes, ...]]:
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
    from subiaco_mapping.config import DecodeConfig
    from subiaco_mapping.decode import PacketDecoder

    decoder = PacketDecoder(_sensor()[0], DecodeConfig())
    data, size = path.read_bytes(), decoder.packet_size
    packets = [data[start : start + size] for start in range(0, len(data), size)]
    scans = [scan for packet in packets for scan in decoder.push(packet)] + decoder.flush()
    assert decoder.counts.packets == len(packets)
    assert all(np.isfinite(scan.first.xyz).all() for scan in scans)
    return scans


def _read_metadata(path: Path) -> object:
    from subiaco_mapping.config import DecodeConfig
    from subiaco_mapping.decode import PacketDecoder

    decoder = PacketDecoder(path.read_text(errors="replace"), DecodeConfig())
    for packet in _sensor()[1][:3]:
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


def _read_kitti(path: Path) -> object:
    from subiaco_geo.trajectories import read_kitti

    path.with_suffix(".times.txt").write_text("".join(f"{k}.5\n" for k in range(5)))
    return read_kitti(path)


def _read_control(path: Path) -> object:
    from subiaco_mapping.control import read_control

    return read_control(path, "EPSG:7850", "EPSG:7850")


def _read_route(path: Path) -> object:
    from subiaco_mapping.watch.routes import read_route

    return read_route(path)


def _read_table(path: Path) -> object:
    from subiaco_change.outputs.table import read_csv

    return read_csv(path)


def _table_seeds(_folder: Path) -> list[bytes]:
    from subiaco_change.outputs.table import COLUMNS

    return [(",".join(COLUMNS) + "\n" + ",".join(["1"] * len(COLUMNS)) + "\n").encode()]


def _read_transform(path: Path) -> object:
    from subiaco_change.job import read_transform

    return read_transform(path)


def _read_map_facts(path: Path) -> object:
    """Read a map directory whose ``map.yaml`` is damaged."""
    from subiaco_geo.maps import read_map, write_map
    from subiaco_geo.survey_map import SurveyMap

    folder = path.parent / "map"
    if not folder.is_dir():
        write_map(folder, SurveyMap(cloud=_small_cloud(), info={"seed": 1}))
    (folder / "map.yaml").write_bytes(path.read_bytes())
    return read_map(folder)


def _map_facts_seeds(folder: Path) -> list[bytes]:
    from subiaco_geo.maps import write_map
    from subiaco_geo.survey_map import SurveyMap

    write_map(folder / "seedmap", SurveyMap(cloud=_small_cloud(), info={"seed": 1}))
    return [(folder / "seedmap" / "map.yaml").read_bytes()]


def _text(*texts: str) -> Callable[[Path], list[bytes]]:
    return lambda _folder: [text.encode() for text in texts]


_TUM = "# a comment\n" + "".join(f"{k}.123456789 {k} 0.5 -1 0 0 0 1\n" for k in range(5))
_KITTI = "1 0 0 5 0 1 0 6 0 0 1 7\n" * 5
_CONTROL = (
    "name,east,north,height,map_east,map_north,map_height\np,391200,6464300,12.5,391200.1,6464300,\n" * 1
)
_ROUTE = (
    '{"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[115.8, -31.9], [115.9, -31.8]]}}'
)

TARGETS = (
    Target("packets", ".bin", _read_packets, lambda _folder: [b"".join(_sensor()[1])]),
    Target("sensor metadata", ".json", _read_metadata, lambda _folder: [_sensor()[0].encode()]),
    Target("bag", ".mcap", _read_bag, _bag_seeds),
    Target("bag metadata", ".yaml", _read_bag_folder, _metadata_yaml_seeds),
    Target("recovery", ".mcap.partial", _recover, _bag_seeds),
    Target("ply", ".ply", _read_cloud, _ply_seeds),
    Target("pcd", ".pcd", _read_cloud, _pcd_seeds),
    Target("las", ".las", _read_cloud, _written(".las")),
    Target("laz", ".laz", _read_cloud, _written(".laz")),
    Target("configuration", ".yaml", _read_config, _config_seeds),
    Target("setting", ".txt", _setting, _text("odometry.voxel=0.8", "crs=EPSG:7850")),
    Target("map facts", ".yaml", _read_map_facts, _map_facts_seeds),
    Target("tum", ".tum", _read_tum, _text(_TUM)),
    Target("kitti", ".txt", _read_kitti, _text(_KITTI)),
    Target("control", ".csv", _read_control, _text(_CONTROL)),
    Target("route", ".geojson", _read_route, _text(_ROUTE)),
    Target("route table", ".csv", _read_route, _text("lat,lon\n-31.9,115.8\n-31.8,115.9\n")),
    Target("change table", ".csv", _read_table, _table_seeds),
    Target("transform", ".txt", _read_transform, _text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")),
)

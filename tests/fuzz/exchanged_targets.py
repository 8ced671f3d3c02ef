"""Readers of what people exchange: map and change directories, truth, recordings, logs, lots.

Formats that are packed or carry check sums are damaged inside, too: members of an archive, columns of a
table, rows of a database. Damage to their bytes alone would end at the check sum.
"""

from __future__ import annotations

import io
import json
import shutil
import sqlite3
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_cases import Edit, Target, damaged, isolated, part

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "change"))

# ---------------------------------------------------------------- damage of packed formats


def damaged_archive(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Damage a member of a zip archive; every fourth case, the archive itself."""
    (_, where, what), *_ = edits
    if what % 4 == 0:
        return damaged(data, edits)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = sorted(members)[where % len(members)]
    members[chosen] = damaged(members[chosen], edits)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


_CELLS: tuple[Any, ...] = (None, "", "text", -1, 2**63 - 1, 1e300, float("nan"), b"\0\1", "2025-13-45", 0)


def damaged_database(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Change cells, columns and tables of an SQLite file (GeoPackage); every fourth case, its bytes."""
    if edits[0][2] % 4 == 0:
        return damaged(data, edits)
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        for kind, where, what in edits:
            names = [row[0] for row in base.execute("select name from sqlite_master where type = 'table'")]
            if not names:
                break
            table = sorted(names)[where % len(names)]
            with suppress(sqlite3.Error, OverflowError):
                _edit_table(base, table, kind, what)
        base.commit()
        return base.serialize()


def _edit_table(base: sqlite3.Connection, table: str, kind: int, what: int) -> None:
    columns = [row[1] for row in base.execute(f'pragma table_info("{table}")')]
    column = columns[what % len(columns)]
    if kind == 0:
        base.execute(f'drop table "{table}"')
    elif kind == 1:
        base.execute(f'alter table "{table}" rename column "{column}" to "other"')
    elif kind == 2:
        base.execute(f'delete from "{table}"')
    elif kind < 6:
        base.execute(f'update "{table}" set "{column}" = ?', (_CELLS[what // 7 % len(_CELLS)],))
    else:
        for row, cell in base.execute(f'select rowid, "{column}" from "{table}"').fetchall():
            if isinstance(cell, bytes):
                worse = damaged(cell, [(kind, what, what // 3)])
                base.execute(f'update "{table}" set "{column}" = ? where rowid = ?', (worse, row))


def damaged_parquet(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Change columns, types, outlines and metadata of a GeoParquet file; every fourth case, its bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if edits[0][2] % 4 == 0:
        return damaged(data, edits)
    table = pq.read_table(io.BytesIO(data))
    for kind, where, what in edits:
        if table.num_columns == 0:
            break
        index = where % table.num_columns
        name, column = table.column_names[index], table.column(index)
        if kind == 0:
            table = table.remove_column(index)
        elif kind == 1:
            table = table.rename_columns(
                [*table.column_names[:index], "other", *table.column_names[index + 1 :]]
            )
        elif kind < 4:
            table = table.set_column(index, name, pa.array([_CELLS[2]] * len(column)))
        elif kind < 6:
            table = table.set_column(index, name, pa.nulls(len(column), column.type))
        elif kind < 8:
            metadata = dict(table.schema.metadata or {})
            metadata[b"geo"] = damaged(metadata.get(b"geo", b"{}"), [(kind, what, what // 3)])
            table = table.replace_schema_metadata(metadata)
        elif pa.types.is_binary(column.type):
            cells = [damaged(cell or b"", [(what, what, what // 3)]) for cell in column.to_pylist()]
            table = table.set_column(index, name, pa.array(cells, column.type))
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


# ---------------------------------------------------------------- map directories


def _small_grid() -> Any:
    from subiaco_geo.clouds import voxel_keys
    from subiaco_geo.observation_times import VoxelObservations
    from subiaco_geo.visibility import TimeRecord, VisibilityGrid

    count = 30
    keys = np.sort(
        voxel_keys(np.stack([np.arange(count), np.arange(count) % 5, np.arange(count) % 3], axis=1))
    )
    ones = np.ones(count, np.uint16)
    looks = VoxelObservations(
        ones, ones, ones, ones.astype(np.uint32), ones.astype(np.uint32), ones.astype(np.uint8)
    )
    return VisibilityGrid(
        np.array([391_200.0, 6_464_300.0, 12.0]), 0.5, keys, ones.astype(np.uint32), ones.astype(np.uint32),
        np.full(count, 20, np.uint8), TimeRecord(0.2, 10**18, looks),
    )  # fmt: skip


def _make_map(folder: Path) -> None:
    from subiaco_geo.clouds import PointCloud
    from subiaco_geo.maps import write_map
    from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
    from subiaco_geo.trajectories import Trajectory

    rng = np.random.default_rng(4)
    times_ns = 10**18 + np.arange(6) * 10**8
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = [391_200.0, 6_464_300.0, 12.0] + np.arange(6)[:, None]
    drive = Trajectory(times_ns, poses)
    cloud = PointCloud(rng.uniform(0, 30, (40, 3)), np.array([391_200.0, 6_464_300.0, 12.0]), "EPSG:7850")
    heights = np.column_stack([poses[:, :3, 3], np.full(6, 40.0), np.full(6, 0.01)])
    spread = np.tile(np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]), (6, 1, 1))
    manifest = {"sequences": {"a": {"start_s": 1.0, "flagged": {"gnss_lost": [{"start_s": 1, "end_s": 2}]}}}}
    survey = SurveyMap(
        cloud, drive, _small_grid(), PoseUncertainty(times_ns, ["a"] * 6, spread), {"seed": 1}, cloud,
        {"a": Trajectory(times_ns, np.tile(np.eye(4), (6, 1, 1)))}, manifest, heights, {"crs": "EPSG:7850"},
    )  # fmt: skip
    write_map(folder, survey)


def _read_map(folder: Path) -> object:
    """Read a map as the comparison of epochs does, and use the parts that depend on each other."""
    from subiaco_geo.maps import read_map, read_map_head
    from subiaco_geo.tile_uncertainty import tile_uncertainty

    survey = read_map(folder)
    read_map_head(folder)
    places = survey.cloud.world()
    if survey.trajectory is not None and survey.uncertainty is not None and len(survey.uncertainty.times_ns):
        centres = survey.trajectory.at(survey.uncertainty.times_ns)[:, :3, 3]
        if survey.heights is not None:
            tile_uncertainty(survey.heights[:, :3], centres, survey.uncertainty.covariances)
    if survey.visibility is not None:
        survey.visibility.observed(places)
        survey.visibility.moved(places)
    return survey


def _read_visibility_parts(path: Path) -> object:
    from subiaco_geo.visibility import visibility_parts

    return [len(grid.keys) for grid in visibility_parts(path, 7)]


def _visibility_seeds(folder: Path) -> list[bytes]:
    from subiaco_geo.visibility import save_visibility

    save_visibility(folder / "seed.npz", _small_grid())
    return [(folder / "seed.npz").read_bytes()]


def _read_manifest(path: Path) -> object:
    """Go on with an earlier watch, whose manifest this is."""
    from subiaco_mapping.health_monitor.files import SurveyFiles, read_manifest

    read_manifest(path)
    (path.parent / "manifest.yaml").write_bytes(path.read_bytes())
    return SurveyFiles(path.parent, "a", [])


def _read_streets(path: Path) -> object:
    from subiaco_mapping.health_monitor.files import STREETS, SurveyFiles

    (path.parent / STREETS).write_bytes(path.read_bytes())
    return SurveyFiles(path.parent, "a", [])


# ---------------------------------------------------------------- change directories and truth


@cache
def _change_directory() -> Path:
    """Write a small change directory, once."""
    import result_scene

    from subiaco_change.outputs.directory import ChangeInputs, write_change_directory

    whole = result_scene.scene_result()
    few = {
        epoch: cloud.select(np.arange(0, len(cloud), 400))
        for epoch, cloud in (("before", whole.before), ("after", whole.after))
    }
    folder = Path(tempfile.mkdtemp(prefix="fuzz-change-")) / "whole"
    write_change_directory(folder, replace(whole, **few), result_scene.SceneConfig(), ChangeInputs())
    return folder


def _make_change(folder: Path) -> None:
    shutil.copytree(_change_directory(), folder)
    rows = (folder / "changes.csv").read_text().splitlines()
    uid = rows[1].split(",")[rows[0].split(",").index("object_uid")]
    (folder / "reviews.csv").write_text(f"object_uid,review,reviewer,note\n{uid},confirmed,ab,seen\n")


def _read_change(folder: Path) -> object:
    """Read a change directory as the report and a second run of the same pair do."""
    from subiaco_change.outputs.change_directory_reading import read_change_directory
    from subiaco_change.outputs.reviews import carry_reviews, read_reviewed

    change = read_change_directory(folder)
    previous = read_reviewed(folder)
    assert previous is not None
    fresh = read_reviewed(_change_directory())
    assert fresh is not None
    carry_reviews(fresh, previous)
    return change


def _read_report(folder: Path) -> object:
    from subiaco_report.page import build_report

    return build_report(folder)


def _read_coverage(folder: Path) -> object:
    from subiaco_change.outputs.rasters import read_coverage

    return read_coverage(folder / "coverage.tif")


def _make_truth(folder: Path) -> None:
    (folder / "truth").mkdir(parents=True)
    (folder / "truth" / "scene.yaml").write_text(
        "preset: default\nseed: 7\nT_after_before: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    (folder / "truth" / "objects.csv").write_text(
        "object_id,class,change,east,north,height\n1,Building,Added,391210,6464310,4.5\n2,Mobile,Removed,1,2,3\n"
    )
    rng = np.random.default_rng(5)
    for epoch in ("before", "after"):
        (folder / epoch / "truth").mkdir(parents=True)
        np.savez(
            folder / epoch / "truth" / "points.npz", xyz=rng.uniform(0, 9, (20, 3)) + 391_200.0,
            change=np.zeros(20, np.uint8), object=np.arange(20), **{"class": np.ones(20, np.uint8)},
        )  # fmt: skip
        rows = "".join(f"{k}.5 {k} 0 1 0 0 0 1\n" for k in range(3))
        (folder / epoch / "truth" / "trajectory.tum").write_text(rows)
    for name in ("before.npy", "after.npy"):
        np.save(folder / name, np.zeros(20, np.int64))


def _read_truth(folder: Path) -> object:
    """Read a truth, and labels of another method for its points."""
    from subiaco_evaluation.layouts import read_prediction, scene_name
    from subiaco_evaluation.truth import read_truth
    from subiaco_geo.simulated import simulation_of

    truth = read_truth(folder)
    simulation_of(folder / "before" / "map.ply")
    scene_name(truth, folder)
    return read_prediction(folder, truth)


# ---------------------------------------------------------------- recordings


@cache
def _sensor() -> tuple[str, tuple[bytes, ...]]:
    from fuzz_targets import small_sensor

    return small_sensor()


def _packets() -> list[Any]:
    from ouster.sdk import core

    info = core.SensorInfo(_sensor()[0])
    made = []
    for number, buf in enumerate(_sensor()[1][:12]):
        packet = core.LidarPacket(core.PacketFormat(info))
        packet.buf[:] = np.frombuffer(buf, np.uint8)
        packet.host_timestamp = 10**18 + number * 10**6
        made.append(packet)
    return made


def _pcap_seeds(folder: Path) -> list[bytes]:
    from ouster.sdk import pcap

    pcap.record(iter(_packets()), str(folder / "seed.pcap"))
    return [(folder / "seed.pcap").read_bytes()]


def _read_pcap(path: Path) -> object:
    from subiaco_mapping.importers.packets import pcap_packets

    return list(pcap_packets(path, _sensor()[0]))


def _osf_seeds(folder: Path) -> list[bytes]:
    from ouster.sdk import core, osf

    info = core.SensorInfo(_sensor()[0])
    batcher, frame = core.FrameBatcher(info), core.LidarFrame(info)
    with osf.Writer(str(folder / "seed.osf"), [info]) as writer:
        for packet in _packets():
            batcher.batch(packet, frame)
        writer.save(0, frame)
    return [(folder / "seed.osf").read_bytes()]


def _read_osf(path: Path) -> object:
    from subiaco_mapping.importers.packets import osf_recording

    return list(osf_recording(path))


_PACKET_MSG = "uint8[] buf"


def _ros1_seeds(folder: Path) -> list[bytes]:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_PACKET_MSG, "ouster_ros/msg/PacketMsg"))
    path = folder / "seed.bag"
    path.unlink(missing_ok=True)
    with Writer(path) as writer:
        said = writer.add_connection("/ouster/metadata", "std_msgs/msg/String", typestore=store)
        raw = writer.add_connection("/ouster/lidar_packets", "ouster_ros/msg/PacketMsg", typestore=store)
        text = b"{}"
        writer.write(said, 10**18, len(text).to_bytes(4, "little") + text)
        for number in range(4):
            body = bytes(range(64))
            writer.write(raw, 10**18 + number, len(body).to_bytes(4, "little") + body)
    return [path.read_bytes()]


def _read_ros1(path: Path) -> object:
    from subiaco_mapping.importers.packets import ros1_recording

    return ros1_recording(path)


def _drive_seeds(folder: Path) -> list[bytes]:
    """A bag with a message of everything that mapping reads."""
    from subiaco_geo.bags import TYPESTORE, BagWriter, packet_to_cdr
    from subiaco_geo.topics import LIDAR_PACKETS, MESSAGE_TYPES, METADATA
    from subiaco_mapping.importers.bag_messages import cloud_message, extrinsics_message, fix_message
    from subiaco_mapping.importers.csv_logs import imu_message

    text = TYPESTORE.types[MESSAGE_TYPES[METADATA]](data=_sensor()[0])
    place = np.array([-31.95, 115.83, 12.0])
    rng = np.random.default_rng(3)
    with BagWriter(folder / "drive", compress=False) as writer:
        writer.write(METADATA, MESSAGE_TYPES[METADATA], text, 10**18, latched=True)
        found = [
            extrinsics_message(10**18, {name: np.eye(4) for name in ("lidar_link", "imu_link", "gnss_link")})
        ]
        for k in range(4):
            now = 10**18 + k * 10**8
            found.append(fix_message(now, place + k * 1e-5, np.eye(3) * 1e-4, 2, known=True))
            found.append(imu_message(now, np.zeros(3), np.array([0, 0, 9.8])))
            times_ns = now + np.arange(20) * 10**6
            found.append(cloud_message(rng.uniform(-9, 9, (20, 3)), times_ns, intensity=np.ones(20)))
        for item in found:
            writer.write_raw(item.topic, MESSAGE_TYPES[item.topic], item.cdr, item.time_ns)
        for k, buf in enumerate(_sensor()[1][:4]):
            writer.write_raw(LIDAR_PACKETS, MESSAGE_TYPES[LIDAR_PACKETS], packet_to_cdr(buf), 10**18 + k)
    return [next((folder / "drive").glob("*.mcap")).read_bytes()]


def _read_drive(path: Path) -> object:
    from subiaco_mapping.inspection.inspect_bag import describe, inspect_bag

    return describe(inspect_bag(path))


class _Sink:
    """Takes what the front end of mapping makes of a drive."""

    def __init__(self) -> None:
        self.taken: list[object] = []

    def __getattr__(self, _name: str) -> Callable[..., None]:
        return lambda *given, **named: self.taken.append((given, named))


def _map_drive(path: Path) -> object:
    """Run the front end of mapping on a damaged drive: decoding, deskew, odometry, fixes."""
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.named_bags import open_bag
    from subiaco_mapping.pipeline import run_sequence

    config, sink = MappingConfig(), _Sink()
    with open_bag(path, config.topics) as reader:
        run_sequence(reader, sink, config, lambda *_: None)
    return sink.taken


# ---------------------------------------------------------------- logs, raw folders, lots


def _read_gnss(path: Path) -> object:
    from subiaco_mapping.importers.csv_logs import LogsConfig, read_gnss_log

    return read_gnss_log(path, LogsConfig())


def _read_imu(path: Path) -> object:
    from subiaco_mapping.importers.csv_logs import LogsConfig, read_imu_log

    return read_imu_log(path, LogsConfig())


_GNSS = """utc,latitude,longitude,height,quality,sigma_east,sigma_north,sigma_up,heading,heading_sigma
2025-03-04T05:06:07.400Z,-31.95000001,115.83000002,12.345,4,0.011,0.012,0.02,90.0,0.3
1741064767.213700001,-31.95,115.83,12.3,5,0.4,0.4,0.7,,
"""
_IMU = (
    "utc, gyro_x, gyro_y, gyro_z, accel_x, accel_y, accel_z\n"
    + "1741064767.2137,0.01,-0.02,0.3,0.1,0.2,9.8\n" * 2
)
_NAMES = (
    "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
)
_SOLUTION = (
    f"% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix)\n%  GPST {_NAMES}\n"
    "2025/07/08 19:34:18.500 -31.95 115.83 12.345 1 9 0.02 0.01 0.03 -0.005 0.0 0.0 0.00 9.9\n"
    "2374 243258.500 -31.95 115.83 12.345 2 9 0.02 0.01 0.03 -0.005 0.0 0.0 0.00 9.9\n"
)


def _make_kitti(folder: Path) -> None:
    points, ins = folder / "velodyne_points", folder / "oxts"
    (points / "data").mkdir(parents=True)
    (ins / "data").mkdir(parents=True)
    xyz = np.array([[-5, 0.001, 0, 0.1], [0, 5, 0, 0.2], [5, 0, 0, 0.3], [0, -5, 0, 1.0]], "<f4")
    row = [49.0, 8.44, 113.0, 0.01, 0.02, 2.4, *[0.0] * 5, 0.1, 0.2, 9.8, *[0.0] * 3, 0.01, 0.02, 0.3]
    row += [0.0] * 3 + [0.08, 0.1, 4, 9, 5, 6, 6]
    stamps = {"": [], "_start": [], "_end": []}
    for k in range(2):
        (points / "data" / f"{k:010d}.bin").write_bytes(xyz.tobytes())
        (ins / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, row)))
        for name, ms in (("_start", 50), ("", 100), ("_end", 150)):
            stamps[name].append(f"2011-09-26 13:21:35.{(100 * k + ms) * 10**6:09d}")
    for name, lines in stamps.items():
        (points / f"timestamps{name}.txt").write_text("\n".join(lines) + "\n")
    (ins / "timestamps.txt").write_text("\n".join(stamps[""]) + "\n")
    (folder / "calib_imu_to_velo.txt").write_text("R: 0 -1 0 1 0 0 0 0 1\nT: -0.8 0.3 -0.7\n")


def _read_kitti_raw(folder: Path) -> object:
    from subiaco_mapping.importers.kitti_raw import kitti_messages

    return list(kitti_messages(folder))


def _lots_seeds(driver: str, suffix: str, crs: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        import geopandas as gpd
        from shapely.geometry import MultiPolygon, box

        shapes = [box(k, 0, k + 1, 1) for k in range(3)]
        lots = gpd.GeoDataFrame(
            {"lot_id": [1, 2, 3]}, geometry=[MultiPolygon([s]) for s in shapes], crs="EPSG:7850"
        )
        lots = lots.set_geometry(lots.translate(391_200, 6_464_300)).to_crs(crs)
        path = folder / f"seed{suffix}"
        path.unlink(missing_ok=True)
        lots.to_file(path, driver=driver, engine="pyogrio")
        return [path.read_bytes()]

    return seeds


def _read_lots(path: Path) -> object:
    from subiaco_change.outputs.parcels import read_lots

    return read_lots(path, "EPSG:7850")


def _copc_seeds(folder: Path) -> list[bytes]:
    from subiaco_geo.clouds import PointCloud
    from subiaco_geo.copc_io import write_copc

    rng = np.random.default_rng(6)
    fields = {"rho": rng.random(300).astype(np.float32)}
    cloud = PointCloud(
        rng.uniform(0, 30, (300, 3)), np.array([391_200.0, 6_464_300.0, 12.0]), "EPSG:7850", fields
    )
    write_copc(folder / "seed.copc.laz", cloud)
    return [(folder / "seed.copc.laz").read_bytes()]


def _read_cloud(path: Path) -> object:
    from subiaco_geo.cloud_io import read_cloud

    return read_cloud(path)


def _read_windows(path: Path) -> object:
    from subiaco_geo.cloud_windows import CloudFile

    cloud = CloudFile(path, ("rho",))
    return cloud.inside(*cloud.low[:2], *cloud.high[:2])


def _json(*documents: object) -> Callable[[Path], list[bytes]]:
    return lambda _folder: [json.dumps(document).encode() for document in documents]


_STREETS = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"kind": "driven", "light": "green", "length_m": 12.0},
            "geometry": {"type": "LineString", "coordinates": [[115.8, -31.9], [115.9, -31.8]]},
        }
    ],
}
_MANIFEST = b"sequences:\n  a:\n    start_s: 1.5\n    flagged: {gnss_lost: [{start_s: 1, end_s: 2}]}\n"

EXCHANGED = (
    *(
        part(f"map {name}", name, _make_map, _read_map)
        for name in (
            "map.yaml", "manifest.yaml", "config.yaml", "trajectory.tum", "uncertainty.csv", "heights.csv",
            "odometry/a.txt", "odometry/a.times.txt",
        )
    ),
    part("map visibility.npz", "visibility.npz", _make_map, _read_map, damaged_archive),
    Target("visibility parts", ".npz", _read_visibility_parts, _visibility_seeds, damage=damaged_archive),
    Target("watch manifest", ".yaml", _read_manifest, lambda _folder: [_MANIFEST]),
    Target("street lights", ".geojson", _read_streets, _json(_STREETS), named=""),
    part("change changes.csv", "changes.csv", _make_change, _read_change),
    part("change reviews.csv", "reviews.csv", _make_change, _read_change),
    part("change changes.parquet", "changes.parquet", _make_change, _read_change, damaged_parquet),
    part("change changes.gpkg", "changes.gpkg", _make_change, _read_change, damaged_database),
    part("change coverage.tif", "coverage.tif", _make_change, _read_coverage),
    *(
        part(f"report {name}", name, _make_change, _read_report)
        for name in ("run.json", "registration.json", "changes.csv")
    ),
    part("truth scene.yaml", "truth/scene.yaml", _make_truth, _read_truth),
    part("truth objects.csv", "truth/objects.csv", _make_truth, _read_truth),
    part("truth points.npz", "before/truth/points.npz", _make_truth, _read_truth, damaged_archive),
    part("truth trajectory.tum", "after/truth/trajectory.tum", _make_truth, _read_truth),
    part("labels before.npy", "before.npy", _make_truth, _read_truth),
    Target("pcap", ".pcap", isolated("exchanged_targets", "_read_pcap"), _pcap_seeds),
    Target("osf", ".osf", isolated("exchanged_targets", "_read_osf"), _osf_seeds),
    Target("ros1 bag", ".bag", _read_ros1, _ros1_seeds),
    Target("drive bag", ".mcap", _read_drive, _drive_seeds),
    Target("drive mapped", ".mcap", _map_drive, _drive_seeds),
    Target("gnss log", ".csv", _read_gnss, lambda _folder: [_GNSS.encode()]),
    Target("imu log", ".csv", _read_imu, lambda _folder: [_IMU.encode()]),
    Target("rtklib", ".pos", _read_gnss, lambda _folder: [_SOLUTION.encode()]),
    *(
        part(f"kitti raw {Path(name).name}", name, _make_kitti, _read_kitti_raw)
        for name in (
            "velodyne_points/data/0000000001.bin", "velodyne_points/timestamps_start.txt",
            "oxts/data/0000000001.txt", "calib_imu_to_velo.txt",
        )
    ),
    Target("lots geojson", ".geojson", _read_lots, _lots_seeds("GeoJSON", ".geojson", "EPSG:4326")),
    Target(
        "lots geopackage", ".gpkg", _read_lots, _lots_seeds("GPKG", ".gpkg", "EPSG:7850"),
        damage=damaged_database,
    ),
    Target("copc", ".copc.laz", _read_cloud, _copc_seeds),
    Target("copc windows", ".copc.laz", _read_windows, _copc_seeds),
)  # fmt: skip

# ruff: noqa: T201
"""Time of the whole mapping room, in process, against kiss_icp alone on the same scans in the same run.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python tests/benchmarks/bench_mapping.py out/demo/sim/before

kiss_icp 1.3 runs with its own deskewing and its defaults, but one thread. It is given decoded points, so
that decoding, IMU, pose graph, fusion, visibility and normals are all on our side of the scale; reading
the bag is on nobody's. Both take turns, scan by scan, so that what else the machine does meets both
alike; CPU seconds, not wall time. With ``--truth`` the position errors of the odometries stand beside,
from their own first pose and before GNSS. Where rko_lio (0.4, not among our dependencies; ``make bench`` puts
it into ``out/bench/peers``) can be imported, it takes the same scans and IMU, its defaults and one thread:

    PYTHONPATH=out/bench/peers python tests/benchmarks/bench_mapping.py ... --rko
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from results import keep, rounded

from subiaco_geo.bags import BagReader, packet_from_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS
from subiaco_geo.trajectories import read_tum
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Extrinsics, ImuSample, Scan
from subiaco_mapping.odometry.frontend import FrontendOutput, OdometryFrontend
from subiaco_mapping.pipeline import read_extrinsics, read_metadata
from subiaco_mapping.preprocessing.conversions import fix_from_msg, imu_from_msg
from subiaco_mapping.preprocessing.decode import PacketDecoder


@dataclass
class Clock:
    """CPU seconds by stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    def run(self, stage: str, step, *arguments):  # type: ignore[no-untyped-def]
        """Call a step on the bill of a stage."""
        start = time.process_time()
        result = step(*arguments)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.process_time() - start
        return result


class KissAlone:
    """kiss_icp as its own pipeline runs it, one thread."""

    def __init__(self) -> None:
        config = KISSConfig()
        config.data.max_range, config.data.min_range, config.data.deskew = 100.0, 1.0, True
        config.mapping.voxel_size = 1.0
        config.registration.max_num_threads = 1
        self._kiss = KissICP(config)
        self.poses: list[Floats] = []

    def register(self, scan: Scan) -> None:
        """Take one decoded scan."""
        times = (scan.first.times_ns - scan.start_ns) * 1e-9
        self._kiss.register_frame(scan.first.xyz, times)
        self.poses.append(self._kiss.last_pose.copy())


class RkoAlone:
    """rko_lio, one thread; a scan waits until the IMU covers it."""

    def __init__(self, extrinsics: Extrinsics) -> None:
        from rko_lio.lio import LIO, LIOConfig

        self._lio = LIO(LIOConfig(max_num_threads=1))
        self._base_lidar, self._base_imu = extrinsics.T_base_lidar, extrinsics.T_base_imu
        self._waiting: list[Scan] = []
        self.poses: list[Floats] = []

    def on_scan(self, scan: Scan) -> None:
        """Take one decoded scan."""
        self._waiting.append(scan)

    def on_imu(self, sample: ImuSample) -> None:
        """Take one IMU sample, and register what it completes."""
        self._lio.add_imu_measurement(sample.accel, sample.gyro, sample.time_ns, self._base_imu)
        while self._waiting and self._waiting[0].end_ns <= sample.time_ns:
            scan = self._waiting.pop(0)
            times = scan.first.times_ns, self._base_lidar, scan.start_ns, scan.end_ns
            self._lio.register_scan(scan.first.xyz, *times)
            self.poses.append(self._lio.pose() @ self._base_lidar)


@dataclass
class Peers:
    """What is measured beside ours."""

    kiss: KissAlone
    rko: RkoAlone | None


def compare(bag: Path, limit: int, with_rko: bool = False) -> tuple[Clock, Peers, list[FrontendOutput]]:
    """Run all over the first ``limit`` scans of a bag."""
    clock, config = Clock(), MappingConfig()
    outputs: list[FrontendOutput] = []
    with BagReader(bag) as reader, tempfile.TemporaryDirectory() as spool:
        extrinsics, metadata = read_extrinsics(reader, config), read_metadata(reader)
        if metadata is None:
            raise InputError(f"{bag}: the benchmark needs packets with metadata")
        decoder = PacketDecoder(metadata, config.decode)  # gives kiss_icp its scans, on nobody's bill
        peers = Peers(KissAlone(), RkoAlone(extrinsics) if with_rko else None)
        frontend = OdometryFrontend(config, extrinsics, metadata)
        backend = MappingBackend(config, extrinsics, Path(spool))
        for message in reader.messages({LIDAR_PACKETS, IMU, FIX}):
            if message.topic == FIX:
                clock.run("graph", backend.on_fix, fix_from_msg(reader.deserialize(message), config.gnss))
                continue
            if message.topic == IMU:
                step, item = frontend.on_imu, clock.run("read", imu_from_msg, reader.deserialize(message))
                if peers.rko is not None:
                    clock.run("rko_lio", peers.rko.on_imu, item)
            else:
                step, item = frontend.on_packet, packet_from_cdr(message.raw)
                for scan in decoder.push(item):
                    clock.run("kiss_icp", peers.kiss.register, scan)
                    if peers.rko is not None:
                        clock.run("rko_lio", peers.rko.on_scan, scan)
            for output in clock.run("front end", step, item):
                clock.run("spool", backend.on_odometry, output.pose, output.scan)
                outputs.append(output)
            if len(outputs) >= limit:
                break
        clock.run("graph", backend.optimize)
        clock.run("fusion", backend.build_map)
    return clock, peers, outputs


def errors(poses: Floats, stamps_ns: np.ndarray, truth: Path) -> Floats:
    """Position errors (S,) [m] from the first pose on."""
    true = read_tum(truth).at(stamps_ns)
    moved = invert_pose(poses[0]) @ poses
    return np.asarray(np.linalg.norm((invert_pose(true[0]) @ true)[:, :3, 3] - moved[:, :3, 3], axis=1))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path)
    parser.add_argument("--scans", type=int, default=10**9)
    parser.add_argument("--truth", type=Path, help="trajectory.tum of the simulated drive")
    parser.add_argument("--rko", action="store_true", help="rko_lio as well, where it can be imported")
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    given = parser.parse_args()
    with_rko = given.rko and importlib.util.find_spec("rko_lio") is not None
    compare(given.bag, 3)  # compiles; not counted
    clock, peers, outputs = compare(given.bag, given.scans, with_rko)
    alone = clock.seconds.pop("kiss_icp")
    others = {} if peers.rko is None else {"rko_lio alone": clock.seconds.pop("rko_lio")}
    ours = sum(clock.seconds.values())
    print(f"{len(outputs)} scans, CPU ms a scan")
    rows = {"kiss_icp alone": alone, **others, **clock.seconds, "mapping, all": ours}
    table = [
        {"stage": s, "CPU ms a scan": rounded(1e3 * t / len(outputs)), "of kiss_icp": rounded(t / alone, 2)}
        for s, t in rows.items()
    ]
    for stage, seconds in rows.items():
        print(f"  {stage:15s} {1e3 * seconds / len(outputs):7.1f}   {seconds / alone:5.2f} of kiss_icp")
    if given.truth is not None:
        stamps = np.array([output.pose.stamp_ns for output in outputs])
        tracks = {"kiss_icp": peers.kiss.poses, "ours": [o.pose.T_odom_lidar for o in outputs]}
        if peers.rko is not None:
            tracks["rko_lio"] = peers.rko.poses
        for name, poses in tracks.items():
            count = min(len(poses), len(stamps))
            error = errors(np.array(poses[:count]), stamps[:count], given.truth)
            print(f"  {name}: odometry error {error[-1]:.3f} m at the end, {error.max():.3f} m at most")
            row = next(r for r in table if r["stage"].split(" ")[0] == {"ours": "mapping,"}.get(name, name))
            row["odometry at most off, mm"] = round(1e3 * float(error.max()))
    absent = {} if peers.rko is not None else {"rko-lio": "not asked for, or it cannot be imported"}
    keep(given.json, table, absent, [f"{len(outputs)} scans, one thread, in turns"])


if __name__ == "__main__":
    main()

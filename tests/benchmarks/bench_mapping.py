# ruff: noqa: T201
"""Time of the whole mapping room, in process, against kiss_icp alone on the same scans in the same run.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python tests/benchmarks/bench_mapping.py out/demo/sim/before

kiss_icp 1.3 runs with its own deskewing and its defaults, but one thread. It is given decoded points, so
that decoding, IMU, pose graph, fusion, visibility and normals are all on our side of the scale; reading
the bag is on nobody's. Both take turns, scan by scan, so that what else the machine does meets both
alike; CPU seconds, not wall time. With ``--truth`` the position errors of both odometries stand beside,
from their own first pose and before GNSS.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from subiaco_geo.bags import BagReader, packet_from_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS
from subiaco_geo.trajectories import read_tum
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.conversions import fix_from_msg, imu_from_msg
from subiaco_mapping.decode import PacketDecoder
from subiaco_mapping.frontend import FrontendOutput, OdometryFrontend
from subiaco_mapping.measurements import Scan
from subiaco_mapping.pipeline import read_extrinsics, read_metadata


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


def compare(bag: Path, limit: int) -> tuple[Clock, list[Floats], list[FrontendOutput]]:
    """Run both over the first ``limit`` scans of a bag."""
    clock, kiss, config = Clock(), KissAlone(), MappingConfig()
    outputs: list[FrontendOutput] = []
    with BagReader(bag) as reader, tempfile.TemporaryDirectory() as spool:
        extrinsics, metadata = read_extrinsics(reader, config), read_metadata(reader)
        if metadata is None:
            raise InputError(f"{bag}: the benchmark needs packets with metadata")
        decoder = PacketDecoder(metadata, config.decode)  # gives kiss_icp its scans, on nobody's bill
        frontend = OdometryFrontend(config, extrinsics, metadata)
        backend = MappingBackend(config, extrinsics, Path(spool))
        for message in reader.messages({LIDAR_PACKETS, IMU, FIX}):
            if message.topic == FIX:
                clock.run("graph", backend.on_fix, fix_from_msg(reader.deserialize(message), config.gnss))
                continue
            if message.topic == IMU:
                step, item = frontend.on_imu, clock.run("read", imu_from_msg, reader.deserialize(message))
            else:
                step, item = frontend.on_packet, packet_from_cdr(message.raw)
                for scan in decoder.push(item):
                    clock.run("kiss_icp", kiss.register, scan)
            for output in clock.run("front end", step, item):
                clock.run("spool", backend.on_odometry, output.pose, output.scan)
                outputs.append(output)
            if len(outputs) >= limit:
                break
        clock.run("graph", backend.optimize)
        clock.run("fusion", backend.build_map)
    return clock, kiss.poses[: len(outputs)], outputs


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
    given = parser.parse_args()
    compare(given.bag, 3)  # compiles; not counted
    clock, kiss, outputs = compare(given.bag, given.scans)
    alone = clock.seconds.pop("kiss_icp")
    ours = sum(clock.seconds.values())
    print(f"{len(outputs)} scans, CPU ms a scan")
    for stage, seconds in {"kiss_icp alone": alone, **clock.seconds, "mapping, all": ours}.items():
        print(f"  {stage:15s} {1e3 * seconds / len(outputs):7.1f}   {seconds / alone:5.2f} of kiss_icp")
    if given.truth is not None:
        stamps = np.array([output.pose.stamp_ns for output in outputs])
        for name, poses in (("kiss_icp", kiss), ("ours", [o.pose.T_odom_lidar for o in outputs])):
            error = errors(np.array(poses), stamps, given.truth)
            print(f"  {name}: odometry error {error[-1]:.3f} m at the end, {error.max():.3f} m at most")


if __name__ == "__main__":
    main()

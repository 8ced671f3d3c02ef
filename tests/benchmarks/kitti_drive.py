# ruff: noqa: T201
"""The real drive of ``kitti_drive_0027`` (188 sweeps of an HDL-64 that are not deskewed) as a survey bag.

    python tests/benchmarks/kitti_drive.py $SUBIACO_TEST_DATA -o out/drive/even --sweeps even --fixes none
    subiaco map out/drive/even -o out/drive/even_map --set crs=EPSG:25832

``/lidar/points`` with a time and a ring for every point, ``/gnss/fix`` from the INS, ``/tf_static``. The
scanner turns clockwise, from the rear over the left, the front and the right; its stamp is when it looks
ahead. Stamps of the INS are multiples of 10 ms; the scanner turns evenly, so that its stamps are a line
through them. The recording is for non-commercial use and is not part of this project.
"""

from __future__ import annotations

import argparse
import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_geo.bags import BagWriter
from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import Floats, Ints, make_pose
from subiaco_geo.topics import LATCHED, MESSAGE_TYPES
from subiaco_mapping.importers.bag_messages import LogMessage, cloud_message, extrinsics_message, fix_message
from subiaco_mapping.importers.kitti_raw import raised

CRS = "EPSG:25832"  # UTM zone 32, ETRS89: the drive is in Karlsruhe
FILE = "kitti_0926_drive_0027.npz"
#: The scanner in the frame of the INS, our ``base_link`` [m]; its rotation is below a degree and left out.
T_BASE_LIDAR = make_pose(np.eye(3), np.array([0.81, -0.32, 0.80]))
SIGMA = (0.15, 0.15, 0.30)  # by how much the positions of the INS step within a second, east, north, up [m]

Subset = Callable[[int, int], bool]
PointChoice = Callable[[Floats], NDArray[np.bool_]]
#: Sweeps by name: called with the number of a sweep and how many there are.
SUBSETS: dict[str, Subset] = {
    "all": lambda k, n: True,
    "even": lambda k, n: k % 2 == 0,
    "odd": lambda k, n: k % 2 == 1,
    "first": lambda k, n: k < n // 2,
    "second": lambda k, n: k >= n // 2,
}


@dataclass(frozen=True)
class Drive:
    """A drive of sweeps in ``lidar_link``, with the INS.

    Parameters
    ----------
    xyz_i16 : (N, 3) int16
    scale : float
        [m].
    offsets : (S + 1,) int64
        Sweep i is ``offsets[i]:offsets[i + 1]``.
    oxts : (S, 10) float64
        Time [s], latitude, longitude [deg], height [m], roll, pitch, yaw (from east) [rad], speed [m/s],
        acceleration, steering.
    """

    xyz_i16: NDArray[np.int16]
    scale: float
    offsets: Ints
    oxts: Floats

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def sweep(self, i: int) -> Floats:
        """Return the points (N, 3) of sweep i, the scanner's elevation angles put right [m]."""
        return raised(self.xyz_i16[self.offsets[i] : self.offsets[i + 1]].astype(np.float64) * self.scale)

    @property
    def period_ns(self) -> float:
        """How long a turn takes [ns]."""
        return float(np.polyfit(np.arange(len(self.oxts)), self.oxts[:, 0] - self.oxts[0, 0], 1)[0]) * 1e9

    @property
    def stamps_ns(self) -> Ints:
        """Times (S,) at which the scanner looks ahead."""
        origin_ns = round(self.oxts[0, 0] * 1e9)
        number = np.arange(len(self.oxts))
        slope, start = np.polyfit(number, self.oxts[:, 0] - self.oxts[0, 0], 1)
        return origin_ns + np.round((start + slope * number) * 1e9).astype(np.int64)

    @property
    def ins_ns(self) -> Ints:
        """Times (S,) of the INS."""
        return np.round(self.oxts[:, 0] * 1e9).astype(np.int64)

    def truth(self) -> Floats:
        """Return ``T_enu_base`` (S, 4, 4) of the INS, about its first position, true north [m]."""
        frame = EnuFrame(*self.oxts[0, 1:4].tolist())
        turn = Rotation.from_euler("ZYX", self.oxts[:, [6, 5, 4]]).as_matrix()
        return make_pose(turn, frame.from_geodetic(*self.oxts[:, 1:4].T))


def read_drive(folder: Path) -> Drive:
    """Read the drive from the folder of real recordings."""
    with np.load(folder / "kitti_drive_0027" / FILE) as data:
        return Drive(data["xyz_i16"], float(data["scale"]), data["offsets"], data["oxts"])


def point_times(xyz: Floats, stamp_ns: int, period_ns: float) -> Ints:
    """Return when points (N, 3) of a sweep were measured, from their azimuth."""
    turned = -np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    return stamp_ns + np.round(turned * period_ns).astype(np.int64)


def rings(xyz: Floats) -> NDArray[np.int64]:
    """Return the laser (N,) of points that lie laser by laser, each from the front leftwards."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    step = np.diff(azimuth, prepend=azimuth[:1])
    turned = azimuth[0] + np.cumsum((step + np.pi) % (2 * np.pi) - np.pi)
    return np.clip(np.floor(turned / (2 * np.pi)).astype(np.int64), 0, 63)


def drive_messages(
    drive: Drive,
    sweeps: Subset,
    *,
    every_ring: int = 1,
    points: PointChoice | None = None,
    fixes: str = "all",
    withheld_s: float = 10.0,
    clock_s: float = 0.0,
) -> Iterator[LogMessage]:
    """Yield the messages of a bag in time order.

    Parameters
    ----------
    drive : Drive
    sweeps : callable
        Which sweeps, see ``SUBSETS``.
    every_ring : int
        2 keeps every second laser.
    points : callable, optional
        Tells which points (N, 3) of a sweep are kept.
    fixes : {"all", "alternate", "none"}
        ``alternate`` withholds every second stretch of ``withheld_s`` [s], the first is kept.
    withheld_s : float
    clock_s : float
        Added to the stamps of the fixes: a clock that is wrong by so much [s].
    """
    yield extrinsics_message(
        int(drive.stamps_ns[0] - drive.period_ns), {"lidar_link": T_BASE_LIDAR, "gnss_link": np.eye(4)}
    )
    yield from heapq.merge(
        _clouds(drive, sweeps, every_ring, points),
        _fixes(drive, fixes, withheld_s, clock_s),
        key=lambda item: item.time_ns,
    )


def _clouds(
    drive: Drive, sweeps: Subset, every_ring: int, points: PointChoice | None
) -> Iterator[LogMessage]:
    stamps_ns, period_ns = drive.stamps_ns, drive.period_ns
    for k in range(len(drive)):
        if sweeps(k, len(drive)):
            xyz = drive.sweep(k)
            ring = rings(xyz)
            kept = (ring % every_ring == 0) & (True if points is None else points(xyz))
            times_ns = point_times(xyz[kept], int(stamps_ns[k]), period_ns)
            yield cloud_message(xyz[kept], times_ns, ring=ring[kept])


def withheld(drive: Drive, withheld_s: float) -> NDArray[np.bool_]:
    """Mark the fixes (S,) in every second stretch of so many seconds, the first is not."""
    stretch = (drive.ins_ns - drive.ins_ns[0]) // round(withheld_s * 1e9)
    return np.asarray(stretch % 2 == 1)


def _fixes(drive: Drive, which: str, withheld_s: float, clock_s: float) -> Iterator[LogMessage]:
    kept = {"all": np.ones(len(drive.oxts), bool), "alternate": ~withheld(drive, withheld_s)}
    covariance = np.diag(np.square(SIGMA))
    for k in [] if which == "none" else np.flatnonzero(kept[which]).tolist():
        time_ns = int(drive.ins_ns[k]) + round(clock_s * 1e9)
        yield fix_message(time_ns, drive.oxts[k, 1:4], covariance, 2, known=True)


def write_drive(drive: Drive, bag: Path, sweeps: str | Subset = "all", **options: object) -> None:
    """Write a bag; ``sweeps`` names one of ``SUBSETS`` or is one, ``options`` as :func:`drive_messages`."""
    chosen = SUBSETS[sweeps] if isinstance(sweeps, str) else sweeps
    with BagWriter(bag) as writer:
        for item in drive_messages(drive, chosen, **options):  # type: ignore[arg-type]
            writer.write_raw(
                item.topic,
                MESSAGE_TYPES[item.topic],
                item.cdr,
                item.time_ns,
                latched=item.topic in LATCHED,
            )


def main() -> None:
    """Write one bag."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of real recordings")
    parser.add_argument("-o", "--output", type=Path, required=True, help="bag to make")
    parser.add_argument("--sweeps", choices=sorted(SUBSETS), default="all")
    parser.add_argument("--every-ring", type=int, default=1, help="2: every second laser")
    parser.add_argument("--fixes", choices=["all", "alternate", "none"], default="all")
    parser.add_argument("--clock", type=float, default=0.0, help="added to the stamps of the fixes [s]")
    given = parser.parse_args()
    write_drive(
        read_drive(given.data), given.output, given.sweeps,
        every_ring=given.every_ring, fixes=given.fixes, clock_s=given.clock,
    )  # fmt: skip
    print(f"{given.output}: written")


if __name__ == "__main__":
    main()

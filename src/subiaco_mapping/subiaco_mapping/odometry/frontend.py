"""The front end: decoding, deskewing and odometry as one step."""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass
from typing import Any

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, ImuSample, OdometryPose, Scan
from subiaco_mapping.odometry.first_motion import first_twist
from subiaco_mapping.odometry.scan_matching import KissOdometry, OdometryBackend
from subiaco_mapping.preprocessing.decode import DecodeCounts, PacketDecoder
from subiaco_mapping.preprocessing.deskew import Deskewer
from subiaco_mapping.preprocessing.imu_clock import ImuClock


@dataclass(frozen=True)
class FrontendOutput:
    """One registered scan."""

    pose: OdometryPose
    scan: DeskewedScan


class OdometryFrontend:
    """Take sensor data in any interleaving of topics, give registered scans in order.

    A scan waits until the IMU covers its end, so that the result depends on each topic's own
    order only; after ``deskew.imu_wait_ns`` of stream time without IMU data, the scan proceeds without.

    Parameters
    ----------
    config : MappingConfig
    extrinsics : Extrinsics
    metadata : str, optional
        Ouster metadata; needed before the first packet (see :meth:`set_metadata`).
    odometry : OdometryBackend, optional
        kiss-icp where not given.
    """

    def __init__(
        self,
        config: MappingConfig,
        extrinsics: Extrinsics,
        metadata: str | None = None,
        odometry: OdometryBackend | None = None,
    ) -> None:
        self._config = config
        self._decoder: PacketDecoder | None = None
        self._deskewer = Deskewer(config.deskew, extrinsics)
        rotation = None if extrinsics.T_base_imu is None else extrinsics.R_lidar_imu
        self._clock = ImuClock(rotation, config.deskew.imu_time_offset_ns)
        self._odometry = odometry or KissOdometry(config.odometry, config.threads)
        self._waiting: deque[Scan] = deque()
        self._first: Scan | None = None  # of an unbroken stretch
        self._latest_ns = 0
        self.dropped_scans = 0
        self.behind_ns = 0  # how far the newest scan lies before one that was registered
        self.implausible_imu = 0
        if metadata is not None:
            self.set_metadata(metadata)

    @property
    def counts(self) -> DecodeCounts:
        """Packet counts; zeros where clouds come instead of packets."""
        return self._decoder.counts if self._decoder is not None else DecodeCounts()

    def set_metadata(self, metadata: str) -> None:
        """Give the sensor's metadata; a second time it is ignored."""
        if self._decoder is None:
            self._decoder = PacketDecoder(metadata, self._config.decode)

    def on_packet(self, buf: bytes | memoryview) -> list[FrontendOutput]:
        """Take one LiDAR packet."""
        if self._decoder is None:
            raise InputError(
                "/ouster/metadata: no sensor metadata before the first packet; "
                "record it with the packets (std_msgs/String, latched)"
            )
        return self._enqueue(self._decoder.push(buf))

    def on_points(self, scan: Scan) -> list[FrontendOutput]:
        """Take one scan of a point cloud topic (see ``conversions.scan_from_points``)."""
        return self._enqueue([scan])

    def on_imu(self, sample: ImuSample) -> list[FrontendOutput]:
        """Take one IMU sample; one that no IMU can measure is counted and left out."""
        if not sample.is_plausible():
            self.implausible_imu += 1
            return []
        self._deskewer.push_imu(sample)
        self._clock.push_imu(sample)
        return self._drain(force=False)

    def finish(self) -> list[FrontendOutput]:
        """Close the stream: waiting scans are processed with the data received so far."""
        if self._decoder is not None:
            self._waiting.extend(self._decoder.flush())
        outputs = self._drain(force=True)
        first, self._first = self._first, None
        return outputs if first is None else [*outputs, self._register(first, self._odometry.twist)]

    def facts(self) -> dict[str, Any]:
        """Return what the manifest notes about the stream; plain values."""
        return {
            "packets": asdict(self.counts),
            "dropped_scans": self.dropped_scans,
            "imu_out_of_order": self._deskewer.out_of_order,
            "imu_implausible": self.implausible_imu,
            "gyro_bias": self._deskewer.gyro_bias.round(6).tolist(),
            **self._clock.facts(),
        }

    def _enqueue(self, scans: list[Scan]) -> list[FrontendOutput]:
        for scan in scans:
            self._latest_ns = max(self._latest_ns, scan.end_ns)
            self._waiting.append(scan)
        return self._drain(force=False)

    def _drain(self, force: bool) -> list[FrontendOutput]:
        outputs: list[FrontendOutput] = []
        while self._waiting and (force or self._deskewer.ready(self._waiting[0], self._latest_ns)):
            outputs += self._step(self._waiting.popleft())
        return outputs

    def _step(self, scan: Scan) -> list[FrontendOutput]:
        held = self._first
        previous_ns = self._odometry.last_stamp_ns if held is None else held.end_ns
        if len(scan.first) == 0 or (previous_ns is not None and scan.end_ns <= previous_ns):
            self.dropped_scans += 1
            self.behind_ns = 0 if previous_ns is None else max(0, previous_ns - scan.end_ns)
            return []
        self.behind_ns = 0
        begins = previous_ns is None or scan.end_ns - previous_ns > self._config.odometry.max_gap_ns
        if begins and not scan.deskewed:
            self._first = scan
            return [] if held is None else [self._register(held, self._odometry.twist)]
        if held is None:
            return [self._register(scan, self._odometry.twist)]
        self._first = None
        twist = first_twist(held, scan, self._config.odometry, self._config.threads)
        return [self._register(held, twist), self._register(scan, twist)]

    def _register(self, scan: Scan, twist: Floats | None) -> FrontendOutput:
        deskewed = self._deskewer.deskew(scan, twist, self._odometry.last_stamp_ns)
        pose = self._odometry.register(deskewed)
        self._clock.push_pose(pose)
        return FrontendOutput(pose, deskewed)

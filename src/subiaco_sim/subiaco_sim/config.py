"""What a simulated survey can be asked for; defaults, units and bounds live here alone."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_sim.families.config import StreetConfig
from subiaco_sim.scene_config import SceneConfig
from subiaco_sim.sensors import SensorName


class LidarMode(StrEnum):
    """Columns a revolution x revolutions a second."""

    COLUMNS_512 = "512x10"
    COLUMNS_1024 = "1024x10"
    COLUMNS_2048 = "2048x10"

    @property
    def columns(self) -> int:
        """Columns a revolution."""
        return int(self.value.split("x")[0])


#: Sensors there are: OS1-64 and OS1-128.
Beams = Literal[64, 128]


class EpochChoice(StrEnum):
    """Which drives to simulate."""

    BEFORE = "before"
    AFTER = "after"
    BOTH = "both"

    @property
    def names(self) -> tuple[str, ...]:
        """Epoch folders to write."""
        return ("before", "after") if self is EpochChoice.BOTH else (self.value,)


class LidarConfig(StrictModel):
    """The moving OS1."""

    max_range: float = Field(100.0, gt=5.0, le=200.0, description="Longest range that returns [m]")
    min_range: float = Field(0.5, gt=0.0, description="Shortest range that returns [m]")
    range_sigma: float = Field(0.012, ge=0.0, description="Range noise, standard deviation [m]")
    range_sigma_slope: float = Field(1e-4, ge=0.0, description="Growth of the range noise [m per m]")
    dropout: float = Field(0.005, ge=0.0, le=1.0, description="Beams lost at random [fraction]")
    divergence: float | None = Field(
        None,
        ge=0.0,
        le=0.01,
        description="Spread of a beam, standard deviation; mixed and twofold returns at edges follow; "
        "the preset's when null [rad]",
    )
    glass: float = Field(0.5, ge=0.0, le=1.0, description="Beams that glass swallows or lets by [fraction]")
    wet_road: float = Field(
        0.0, ge=0.0, le=1.0, description="Grazing beams that a wet road swallows [fraction]"
    )
    second_return: float = Field(
        0.45, ge=0.0, le=1.0, description="Beams that go on past a leaf or a wire and return twice [fraction]"
    )


class ImuConfig(StrictModel):
    """The inertial unit, in its own frame."""

    rate: float = Field(100.0, ge=50.0, le=500.0, description="Samples a second [Hz]")
    gyro_noise: float = Field(2e-4, ge=0.0, description="Noise density [rad/s per sqrt(Hz)]")
    accel_noise: float = Field(2e-3, ge=0.0, description="Noise density [m/s2 per sqrt(Hz)]")
    gyro_bias: float = Field(2e-3, ge=0.0, description="Constant bias, standard deviation per axis [rad/s]")
    ouster_packets: bool = Field(False, description="Also record the inertial packets of the LiDAR itself")
    accel_bias: float = Field(0.03, ge=0.0, description="Constant bias, standard deviation per axis [m/s2]")


class GnssConfig(StrictModel):
    """The RTK receiver: shares of the drive in each state, and its errors."""

    rate: float = Field(5.0, gt=0.0, le=20.0, description="Fixes a second [Hz]")
    sigma_fixed: float = Field(0.012, gt=0.0, description="RTK fixed, horizontal [m]")
    sigma_float: float = Field(0.35, gt=0.0, description="RTK float, horizontal [m]")
    sigma_single: float = Field(1.5, gt=0.0, description="Single point, horizontal [m]")
    vertical_factor: float = Field(1.7, gt=0.0, description="Vertical over horizontal error [ratio]")
    correlation_time: float = Field(20.0, gt=0.0, description="Of the slow part of the error [s]")
    float_share: float = Field(0.06, ge=0.0, le=1.0, description="Part of the drive with float fixes")
    single_share: float = Field(0.03, ge=0.0, le=1.0, description="Part of the drive with single fixes")
    none_share: float = Field(0.03, ge=0.0, le=1.0, description="Part of the drive without a fix (NaN)")
    heading_sigma_deg: float | None = Field(
        0.15, gt=0.0, description="Heading of the two antennas; null for one antenna, no heading [deg]"
    )


class FaultConfig(StrictModel):
    """Faults of the recording, each a switch."""

    packet_loss: float = Field(0.0, ge=0.0, lt=1.0, description="LiDAR packets lost [fraction]")
    duplicates: float = Field(0.0, ge=0.0, lt=1.0, description="LiDAR packets sent twice [fraction]")
    reordered: float = Field(
        0.0, ge=0.0, lt=1.0, description="LiDAR packets swapped with the next [fraction]"
    )
    pps_lost: float | None = Field(
        None, ge=0.0, description="From this second of the drive the LiDAR's clock runs free [s]"
    )
    clock_drift: float = Field(
        20e-6, ge=-1e-3, le=1e-3, description="Rate error of a LiDAR clock that runs free [s per s]"
    )
    stamps_zeroed: float = Field(
        0.0, ge=0.0, lt=1.0, description="LiDAR packets whose column stamps are zero [fraction]"
    )
    clock_leap: float = Field(0.0, description="Leap of the LiDAR's stamps in the middle of the drive [s]")
    canyons: bool = Field(False, description="Fixes degrade down to none where the sky is hidden")
    multipath: int = Field(
        0, ge=0, le=100, description="Stretches of 4 s with fixes off by metres that claim RTK fixed"
    )
    multipath_size: float = Field(1.5, gt=0.0, description="Size of such an error [m]")


class MapErrorConfig(StrictModel):
    """Errors of the fused map of the earlier epoch, as an older survey has them; each a switch."""

    shift: float = Field(0.0, ge=0.0, description="How far off the map lies, horizontally [m]")
    rotation_deg: float = Field(0.0, description="How far it is turned about the vertical [deg]")
    tilt_deg: float = Field(0.0, ge=0.0, description="How far it is tilted [deg]")
    drift: float = Field(0.0, ge=0.0, description="Slow bending over some 200 m, amplitude at most [m]")
    shear: float = Field(0.0, ge=0.0, description="Local shear within 25 m of one place [m]")
    duplicates: float = Field(
        0.0, ge=0.0, le=1.0, description="Share of the drive whose facades stand twice in the map"
    )
    duplicate_offset: float = Field(0.3, gt=0.0, description="Distance of such a second facade [m]")


class TruthConfig(StrictModel):
    """How the truth is thinned and how seeing is tested."""

    leaf: float = Field(0.1, gt=0.0, le=1.0, description="One truth point per object and voxel of [m]")
    seen_radius: float = Field(
        0.5, gt=0.0, description="A place counts as seen when a beam of the other drive comes this near [m]"
    )
    own_body: float = Field(
        2.0, ge=0.0, description="A changed object hides its own earlier or later self up to this depth [m]"
    )
    seen_range: float = Field(
        60.0,
        gt=0.0,
        description="Farther than this the other drive counts as blind [m]",
    )
    pose_spacing: float = Field(
        1.5, gt=0.0, description="Distance between tested poses of the other drive [m]"
    )


class SimulationConfig(StrictModel):
    """One simulated survey."""

    preset: str = Field(
        "default", description="easy, default, hard, city, suburb, suburb_hard, dense or dense_hard"
    )
    seed: int = Field(1, ge=0, description="Everything random follows from it")
    city_loops: int = Field(20, ge=1, le=400, description="Loops of the preset city, a survey each")
    city_loop: int | None = Field(None, ge=0, le=399, description="Only this loop of the preset city, from 0")
    epoch: EpochChoice = Field(EpochChoice.BOTH, description="before, after or both")
    maps_only: bool = Field(False, description="Write fused maps from true poses, no bags")
    duration: float | None = Field(
        None, gt=1.0, le=3600.0, description="Length of each drive [s]; the preset's when null"
    )
    mode: LidarMode = Field(LidarMode.COLUMNS_1024, description="Columns x revolutions a second")
    beams_before: Beams | None = Field(None, description="Beams of the earlier drive; the preset's when null")
    beams_after: Beams | None = Field(None, description="Beams of the later drive; the preset's when null")
    sensor_before: SensorName | None = Field(
        None, description="Sensor of the earlier drive, by real beam angles; a family preset's when null"
    )
    sensor_after: SensorName | None = Field(
        None, description="Sensor of the later drive, by real beam angles; a family preset's when null"
    )
    lane_before: int | None = Field(
        None, ge=0, le=2, description="Lane of the earlier drive, 0 beside the crown; the preset's when null"
    )
    lane_after: int | None = Field(
        None, ge=0, le=2, description="Lane of the later drive, 0 beside the crown; the preset's when null"
    )
    reverse_after: bool | None = Field(
        None, description="The later drive goes the other way; the preset's when null"
    )
    dual_return: bool = Field(False, description="Two returns a beam, strongest first")
    ground_cell: float | None = Field(
        None, ge=0.1, le=2.0, description="Edge of the ground mesh [m]; the preset's when null"
    )
    map_every: int = Field(1, ge=1, le=10, description="Scans that enter fused maps: one in so many")
    map_leaf: float = Field(0.25, gt=0.0, le=2.0, description="Leaf of the fused maps [m]")
    recorded_drive: Path | None = Field(
        None, description="Folder of a recorded drive (gnss*.pos, imu*.csv.gz) whose speed and swing to take"
    )
    scene: SceneConfig = SceneConfig()
    street: StreetConfig = StreetConfig()
    lidar: LidarConfig = LidarConfig()
    imu: ImuConfig = ImuConfig()
    gnss: GnssConfig = GnssConfig()
    faults: FaultConfig = FaultConfig()
    maps: MapErrorConfig = MapErrorConfig()
    truth: TruthConfig = TruthConfig()

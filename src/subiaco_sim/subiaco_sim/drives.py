"""The two drives through a scene: when, which way, with which sensors and noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from ouster.sdk.core import SensorInfo

from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_sim.ahead import ahead
from subiaco_sim.config import MapErrorConfig, SimulationConfig
from subiaco_sim.lidar import SCAN_NS, Lidar, SimulatedScan, column_times, points_of
from subiaco_sim.map_errors import MapWarp
from subiaco_sim.motion import LANE, Motion, drive
from subiaco_sim.movers import freeze
from subiaco_sim.packets import sensor_info, true_sensor_info
from subiaco_sim.presets import FamilyPreset, build_family_scene, build_scene, find_preset, with_preset
from subiaco_sim.recorded import read_recorded_drive
from subiaco_sim.scene import EPOCHS, CompiledScene, Scene, compile_scene, ground_object
from subiaco_sim.scene_config import LANE_WIDTH
from subiaco_sim.sensors import SENSORS
from subiaco_sim.vehicle import LIDAR

MAP_CRS = "EPSG:7850"
WORLD = EnuFrame(-31.948, 115.825, 10.0)  # Subiaco; scene coordinates are this frame's
START_NS = {"before": 1_697_335_200_000_000_000, "after": 1_760_236_200_000_000_000}  # UTC


@dataclass(frozen=True)
class Drive:
    """One epoch's drive, ready to be sampled."""

    epoch: str
    number: int
    motion: Motion
    compiled: CompiledScene
    columns: int
    scans: int
    info: SensorInfo

    def rng(self, seed: int, purpose: int, part: int = 0) -> np.random.Generator:
        """Return the random source of one purpose and part of this drive."""
        return np.random.default_rng([seed, 100 + self.number, purpose, part])

    def lidar_poses(self, times_ns: Ints) -> Floats:
        """Return T_enu_lidar (N, 4, 4)."""
        return self.motion.poses(times_ns) @ LIDAR.T_base_sensor

    def scan_end_ns(self) -> Ints:
        """Return the time of every scan's last column (scans,)."""
        ends = [column_times(self.motion.start_ns, k, self.columns)[-1] for k in range(self.scans)]
        return np.array(ends, dtype=np.int64)


@dataclass(frozen=True)
class Survey:
    """A scene and both drives through it."""

    config: SimulationConfig
    scene: Scene
    drives: dict[str, Drive]


@dataclass(frozen=True)
class ScanPoints:
    """First returns of a scan: ENU points (N, 3), ranges known, reflectivity and object ids (N,)."""

    xyz: Floats
    reflectivity: Floats
    object_id: Ints


def plan_survey(config: SimulationConfig) -> Survey:
    """Build the scene and both drives; the survey's settings are complete with those of the preset."""
    preset = find_preset(config.preset)
    config = with_preset(config)
    scene = _scene_of(config)
    duration = config.duration or preset.duration
    folder = config.recorded_drive
    recorded = read_recorded_drive(folder) if folder is not None else None
    drives = {}
    for number, epoch in enumerate(EPOCHS):
        motion = drive(
            scene.route,
            scene.terrain_at(epoch),
            START_NS[epoch],
            duration,
            preset.speed,
            reverse=epoch == "after" and bool(config.reverse_after),
            seed=config.seed * 2 + number + 1_000_003 * (config.city_loop or 0),
            place=preset.place[number],
            recorded=recorded,
            lane=_lane(config, number),
        )
        scans = int(duration * 1e9 // SCAN_NS)
        info = _sensor_of(config, number)
        compiled = compile_scene(scene, epoch)
        drives[epoch] = Drive(epoch, number, motion, compiled, config.mode.columns, scans, info)
    return Survey(config, scene, drives)


def _scene_of(config: SimulationConfig) -> Scene:
    """Build the scene that complete settings ask for."""
    if isinstance(find_preset(config.preset), FamilyPreset):
        return build_family_scene(config)
    return build_scene(
        config.preset,
        config.seed,
        config.ground_cell,
        config.city_loop or 0,
        config.scene,
        bool(config.reverse_after),
    )


def _sensor_of(config: SimulationConfig, number: int) -> SensorInfo:
    """Return the metadata of an epoch's sensor: one of real beam angles, else by its number of beams."""
    name = (config.sensor_before, config.sensor_after)[number]
    if name is not None:
        return true_sensor_info(config.mode, config.dual_return, SENSORS[name])
    beams = (config.beams_before, config.beams_after)[number] or 128
    return sensor_info(config.mode, config.dual_return, beams)


def _lane(config: SimulationConfig, number: int) -> float:
    """Return how far left of the crown an epoch's lane lies [m]; negative where traffic keeps right."""
    lane = (config.lane_before, config.lane_after)[number] or 0
    preset = find_preset(config.preset)
    plan = preset.plan(config.street, config.seed) if isinstance(preset, FamilyPreset) else None
    lanes = config.scene.character.lanes if plan is None else plan.lanes
    if lane >= lanes:
        raise InputError(
            f"lane_{EPOCHS[number]} {lane}: there are {lanes} each way; ask for 0 to {lanes - 1}"
        )
    return LANE + LANE_WIDTH * lane if plan is None else plan.lane_offset(number, lane)


def warp_of(survey: Survey, epoch: str) -> MapWarp:
    """Return the errors of the fused map of an epoch; a drive that is recorded has none."""
    config = survey.config
    wrong = config.maps if config.maps_only and epoch == "before" else MapErrorConfig()
    middle = survey.scene.route[len(survey.scene.route) // 2]
    return MapWarp(wrong, np.append(middle, 0.0), config.seed)


def lidar_of(survey: Survey, drive: Drive) -> Lidar:
    """Return the sensor of a drive."""
    return Lidar(drive.info, survey.config.lidar, survey.config.dual_return)


def scans_of(survey: Survey, drive: Drive, lidar: Lidar) -> Iterator[SimulatedScan]:
    """Yield every scan of a drive; for fused maps, those that enter them."""
    scene, config = survey.scene, survey.config
    terrain = scene.terrain_at(drive.epoch)
    movers = [mover for mover in scene.moving if mover.epoch == drive.epoch]

    def scan_at(k: int) -> SimulatedScan:
        times_ns = column_times(drive.motion.start_ns, k, drive.columns)
        poses = drive.lidar_poses(times_ns)
        seconds = float(drive.motion.seconds(times_ns[:1])[0])
        now = freeze(drive.compiled, movers, terrain, scene.route, seconds, poses[0, :3, 3])
        return lidar.scan(now, k, times_ns, poses, drive.rng(config.seed, 1, k))

    yield from ahead(scan_at, range(0, drive.scans, config.map_every if config.maps_only else 1))


def first_points(survey: Survey, lidar: Lidar, scan: SimulatedScan) -> ScanPoints:
    """Return the measured first returns at the true poses, with their objects."""
    found = scan.first.range_mm > 0
    xyz = points_of(lidar.beams, scan, scan.first.range_mm.astype(np.float64) * 1e-3)[found]
    object_id = ground_object(survey.scene, xyz, scan.first.object_id[found])
    return ScanPoints(xyz, scan.first.reflectivity[found].astype(np.float64), object_id)

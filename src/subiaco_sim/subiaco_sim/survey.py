"""Simulate a survey: two drives through one scene, as bags or as fused maps, with truth."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from subiaco_geo.atomic import whole_directory
from subiaco_geo.codes import Change
from subiaco_geo.frames import Ints
from subiaco_sim.clock import LidarClock
from subiaco_sim.collect import FirstPoints
from subiaco_sim.config import SimulationConfig
from subiaco_sim.drives import Drive, Survey, first_points, lidar_of, plan_survey, scans_of, warp_of
from subiaco_sim.fused import MapFuser
from subiaco_sim.gnss import simulate_gnss
from subiaco_sim.imu import simulate_imu
from subiaco_sim.labels import Labels, label_scene
from subiaco_sim.lidar import Lidar, SimulatedScan
from subiaco_sim.packets import COLUMNS_PER_PACKET, PacketMaker, TimedPacket, inner_imu
from subiaco_sim.presets import find_preset, simulator_hash
from subiaco_sim.recording import (
    fix_arrivals,
    heading_arrivals,
    imu_arrivals,
    imu_packet_arrivals,
    packet_arrivals,
    write_bag,
)
from subiaco_sim.scene import BUILDING
from subiaco_sim.truth import point_changes, write_objects, write_points, write_scene, write_trajectory

Progress = Callable[[str, float], None]
Counts = tuple[Ints, Ints]

_log = logging.getLogger(__name__)


def simulate(
    out: Path, config: SimulationConfig, progress: Progress | None = None, *, overwrite: bool = False
) -> None:
    """Write a simulated survey; nothing is left under ``out`` unless it is whole.

    Parameters
    ----------
    out : Path
        Folder to make: ``<epoch>/bag`` or ``<epoch>/map.ply``, ``<epoch>/truth``, ``truth``; of a
        city, one such folder a loop.
    config : SimulationConfig
    progress : callable, optional
        Called with the stage and the share done, 0 to 1.
    overwrite : bool
        Replace ``out`` where it exists.

    Raises
    ------
    InputError
        ``out`` exists, the preset does not, or the street is shorter than the drive.
    """
    say = progress or (lambda stage, share: _log.debug("%s %.0f %%", stage, 100 * share))
    with whole_directory(out, overwrite=overwrite, marker="truth") as folder:
        if find_preset(config.preset).pitch is not None and config.city_loop is None:
            _simulate_city(folder, config, say)
        else:
            _simulate_loop(folder, config, say)


def _simulate_city(folder: Path, config: SimulationConfig, say: Progress) -> None:
    """Write one survey a loop, in one map frame; only one loop is in memory at a time."""
    listed = []
    for loop in range(config.city_loops):
        name = f"loop_{loop + 1:02d}"

        def within(stage: str, share: float, *, loop: int = loop) -> None:
            say(f"loop {loop + 1} {stage}", share)

        _simulate_loop(folder / name, config.model_copy(update={"city_loop": loop}), within)
        listed.append(name)
    (folder / "truth").mkdir()
    city = {"preset": config.preset, "seed": config.seed, "simulator_hash": simulator_hash(), "loops": listed}
    (folder / "truth" / "city.yaml").write_text(yaml.safe_dump(city, sort_keys=False))


def _simulate_loop(folder: Path, config: SimulationConfig, say: Progress) -> None:
    """Write one survey: both epochs of one drive."""
    say("scene", 0.0)
    survey = plan_survey(config)
    labels = label_scene(survey.scene)
    say("scene", 1.0)
    counts, hashes = {}, {}
    for epoch in config.epoch.names:
        counts[epoch], hashes[epoch] = _simulate_epoch(folder / epoch, survey, epoch, labels, say)
    truth = folder / "truth"
    truth.mkdir()
    write_objects(truth / "objects.csv", survey, labels, counts)
    write_scene(truth / "scene.yaml", survey, labels, hashes)


def _simulate_epoch(
    folder: Path, survey: Survey, epoch: str, labels: Labels, say: Progress
) -> tuple[Counts, str]:
    """Drive one epoch; returns points by object (all, seen) and the hash of the packets."""
    config, drive = survey.config, survey.drives[epoch]
    (folder / "truth").mkdir(parents=True)
    lidar = lidar_of(survey, drive)
    points = FirstPoints(config.truth.leaf)
    warp = warp_of(survey, epoch)
    building = labels.semantic == BUILDING
    fuser = MapFuser(config.map_leaf, drive, warp, lidar.beams, building) if config.maps_only else None
    scans = _observed(survey, drive, lidar, points, fuser, say)
    digest = ""
    if fuser is None:
        digest = _record(folder / "bag", survey, drive, scans)
    else:
        for _ in scans:
            pass
    say(f"{epoch} truth", 0.0)
    write_trajectory(folder / "truth", drive, warp)
    xyz, object_id = points.result()
    fused = fuser.result() if fuser is not None else None
    if fused is None:
        change = point_changes(survey, epoch, labels, xyz, object_id)
    else:  # one test for both: most cells are the same
        every = np.concatenate([xyz, fused[0]]), np.concatenate([object_id, fused[2]])
        change = point_changes(survey, epoch, labels, *every)
    if fuser is not None and fused is not None:
        fuser.write(folder, labels, fused, change[len(xyz) :])
    change = change[: len(xyz)]
    write_points(folder / "truth", labels, xyz, object_id, change, warp)
    say(f"{epoch} truth", 1.0)
    return _count(object_id, change, len(labels.change)), digest


def _count(object_id: Ints, change: NDArray[np.uint8], size: int) -> Counts:
    seen = object_id[change != Change.UNOBSERVED]
    return np.bincount(object_id, minlength=size), np.bincount(seen, minlength=size)


def _observed(
    survey: Survey, drive: Drive, lidar: Lidar, points: FirstPoints, fuser: MapFuser | None, say: Progress
) -> Iterator[SimulatedScan]:
    """Pass the scans on, and keep their points on the way."""
    for scan in scans_of(survey, drive, lidar):
        found = first_points(survey, lidar, scan)
        points.add(found.xyz, found.object_id)
        if fuser is not None:
            fuser.add(scan, found)
        yield scan
        say(drive.epoch, (scan.frame_id + 1) / drive.scans)


def _record(path: Path, survey: Survey, drive: Drive, scans: Iterator[SimulatedScan]) -> str:
    """Write the bag of a drive and return the hash of its packets."""
    config = survey.config
    digest = hashlib.sha256()
    maker = PacketMaker(drive.info)
    clock = LidarClock(config.faults, drive.motion.start_ns, drive.motion.duration)

    def packets() -> Iterator[TimedPacket]:
        for scan in scans:
            rng = drive.rng(config.seed, 5, scan.frame_id)
            stamps = clock.stamps(scan.times_ns, COLUMNS_PER_PACKET, rng)
            for packet in maker.packets(scan, stamps):
                digest.update(packet.buf)
                yield packet

    imu = simulate_imu(drive.motion, config.imu, drive.rng(config.seed, 2))
    rng = drive.rng(config.seed, 3)
    gnss = simulate_gnss(drive.motion, config.gnss, rng, config.faults, drive.compiled)
    streams = [
        packet_arrivals(packets(), config.faults, drive.rng(config.seed, 4)),
        imu_arrivals(imu),
        fix_arrivals(gnss),
        heading_arrivals(gnss),
    ]
    if config.imu.ouster_packets:
        inner = simulate_imu(drive.motion, config.imu, drive.rng(config.seed, 6), inner_imu(drive.info))
        stamps = clock.stamps(inner.times_ns, 1, drive.rng(config.seed, 7))
        streams.append(imu_packet_arrivals(inner, stamps))
    write_bag(path, drive.info.to_json_string(), drive.motion.start_ns, streams)
    return digest.hexdigest()

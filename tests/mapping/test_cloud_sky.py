"""Clouds of returns alone: the places that their rings lack show which beams met nothing."""

from pathlib import Path

import numpy as np
from mapping_scenes import START_NS, pcap_bufs, point_cloud_message
from ouster.sdk import core

from subiaco_mapping.config import MappingConfig
from subiaco_mapping.preprocessing.cloud_sky import SkyOfClouds
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.conversions import scan_from_points
from subiaco_mapping.preprocessing.decode import PacketDecoder

RINGS, COLUMNS, HEIGHT = 32, 720, 1.9
ELEVATIONS = np.radians(np.linspace(15.0, -16.0, RINGS))
WALL, WALL_TOP, WALL_HALF = 12.0, 1.6, 8.0  # ahead: distance, top above the scanner, half width [m]


def beams() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (N, 3), ring (N,) and time (N,) [ns] of a turn."""
    azimuth = (np.arange(COLUMNS) + 0.5) * (2 * np.pi / COLUMNS) - np.pi
    ring, column = (index.ravel() for index in np.mgrid[:RINGS, :COLUMNS])
    high, around = ELEVATIONS[ring], azimuth[column]
    direction = np.stack([np.cos(high) * np.cos(around), np.cos(high) * np.sin(around), np.sin(high)], axis=1)
    return direction, ring.astype(np.uint16), START_NS + column * (100_000_000 // COLUMNS)


def ranges(direction: np.ndarray, wall: bool = True) -> np.ndarray:
    """Distance to the road or a wall ahead [m]; inf into the sky."""
    with np.errstate(divide="ignore"):
        road = np.where(direction[:, 2] < 0, -HEIGHT / direction[:, 2], np.inf)
        front = np.where(direction[:, 0] > 0, WALL / direction[:, 0], np.inf)
    with np.errstate(invalid="ignore"):
        inside = (np.abs(front * direction[:, 1]) < WALL_HALF) & (front * direction[:, 2] < WALL_TOP)
    found = np.minimum(road, np.where(inside & wall, front, np.inf))
    return np.where(found > 100.0, np.inf, found)


def cloud(wall: bool = True, drop_outs: float = 0.0, seed: int = 1):
    """The returns of a turn: points (N, 3), times and rings (N,)."""
    rng = np.random.default_rng(seed)
    direction, ring, times = beams()
    distance = ranges(direction, wall)
    met = np.isfinite(distance) & (rng.random(len(distance)) >= drop_outs)
    noisy = distance[met] + rng.normal(0, 0.01, np.count_nonzero(met))
    return direction[met] * noisy[:, None], times[met], ring[met]


def test_the_sky_is_found_above_the_road_and_not_through_the_wall() -> None:
    sky = SkyOfClouds()
    xyz, times, ring = cloud(drop_outs=0.03)
    for _ in range(2):
        found = sky.find(xyz, times, ring, 40.0)
    # only the rings that met something: those above the wall are known from nothing
    assert found is not None
    assert len(found) > 100
    unit = found.xyz / np.linalg.norm(found.xyz, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(found.xyz, axis=1), 40.0)
    assert np.isinf(ranges(unit)).all()
    np.testing.assert_allclose(np.arcsin(unit[:, 2]), ELEVATIONS[found.ring], atol=np.radians(0.1))
    behind = np.arctan2(unit[:, 1], unit[:, 0]) + np.pi
    expected = START_NS + np.floor(behind * COLUMNS / (2 * np.pi)) * (100_000_000 // COLUMNS)
    assert np.abs(found.times_ns - expected).max() <= 2 * (100_000_000 // COLUMNS)


def test_a_ring_that_meets_the_sky_alone_is_known_from_earlier_clouds() -> None:
    """A wall of 40 m gives all rings points; in the open that follows, they are sky."""
    direction, ring, times = beams()
    sky = SkyOfClouds()
    sky.find(direction * 10.0, times, ring, 40.0)
    found = sky.find(*cloud(wall=False), 40.0)
    assert found is not None
    assert found.ring.min() <= 2


def test_a_column_that_was_lost_proves_nothing() -> None:
    direction, ring, times = beams()
    sky = SkyOfClouds()
    sky.find(direction * 10.0, times, ring, 40.0)
    xyz, times, ring = cloud(wall=False)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    kept = np.abs(azimuth - 1.0) > 0.1
    found = sky.find(xyz[kept], times[kept], ring[kept], 40.0)
    assert found is not None
    assert np.abs(np.arctan2(found.xyz[:, 1], found.xyz[:, 0]) - 1.0).min() > 0.1


def test_a_scanner_without_rings_of_its_own_elevations_has_no_known_sky() -> None:
    xyz, times, ring = cloud()
    shuffled = np.random.default_rng(2).permutation(ring)
    assert SkyOfClouds().find(xyz, times, shuffled, 40.0) is None
    assert SkyOfClouds().find(xyz, times, np.zeros_like(ring), 40.0) is None
    assert SkyOfClouds().find(xyz, times, ring, 0.0) is None
    assert SkyOfClouds().find(xyz[:5], times[:5], ring[:5], 40.0) is None


def test_a_point_cloud_message_brings_its_sky() -> None:
    xyz, times, ring = cloud()
    message = point_cloud_message(xyz, START_NS, t=(times - START_NS).astype("<u4"), ring=ring.astype("<u2"))
    scan = scan_from_points(message, MappingConfig(), SkyOfClouds())
    assert scan.sky is not None
    assert len(scan.sky) > 100
    assert scan_from_points(message, MappingConfig(deskewed=True), SkyOfClouds()).sky is None
    assert scan_from_points(message, MappingConfig()).sky is None


def test_the_returns_of_a_real_scan_give_the_sky_that_its_packets_give(shared_data: Path) -> None:
    name = "OS-1-128_v2.3.0_1024x10"
    metadata = (shared_data / "ouster" / f"{name}.json").read_text()
    decoder = PacketDecoder(metadata, DecodeConfig(min_range=0.0, max_range=300.0))
    bufs = pcap_bufs(shared_data / "ouster" / f"{name}_lb_n3.pcap", metadata)
    scan = next(scan for buf in bufs for scan in decoder.push(buf))
    found = SkyOfClouds().find(scan.first.xyz, scan.first.times_ns, scan.first.ring, 40.0)
    assert found is not None
    assert len(found) > 100
    info = core.SensorInfo(metadata)
    assert found.ring.max() < info.format.pixels_per_column
    unit = found.xyz / np.linalg.norm(found.xyz, axis=1, keepdims=True)
    hits = scan.first.xyz / np.linalg.norm(scan.first.xyz, axis=1, keepdims=True)
    nearest = np.array([np.arccos(np.clip((hits @ beam).max(), -1, 1)) for beam in unit])
    assert np.mean(nearest > 1.5 * 2 * np.pi / 1024) > 0.98  # no return within two columns

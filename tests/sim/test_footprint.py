"""What a beam that is no line meets at edges, wires, leaves, glass; seeds are stated."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_geo.frames import make_pose
from subiaco_sim.config import LidarConfig, LidarMode
from subiaco_sim.footprint import PARTING, Neighbours, merge
from subiaco_sim.furniture import Wires
from subiaco_sim.lidar import Lidar, SimulatedScan, beams_of, column_times
from subiaco_sim.packets import sensor_info
from subiaco_sim.primitives import REFLECTIVITY, Material, Mesh, box
from subiaco_sim.scene import Hits, compile_meshes

EXACT = LidarConfig(range_sigma=0, range_sigma_slope=0, dropout=0, divergence=0)
WIDE = EXACT.model_copy(update={"divergence": 1.5e-3})


def scan(config: LidarConfig, *meshes: Mesh, dual: bool = True) -> SimulatedScan:
    """Scan meshes from 2 m above the origin (seed 4)."""
    scene = compile_meshes(list(enumerate(meshes)))
    lidar = Lidar(sensor_info(LidarMode.COLUMNS_1024, dual=dual), config, dual)
    pose = np.tile(make_pose(np.eye(3), [0.0, 0.0, 2.0]), (1024, 1, 1))
    return lidar.scan(scene, 0, column_times(0, 0, 1024), pose, np.random.default_rng(4))


def seconds(found: SimulatedScan) -> np.ndarray:
    assert found.second is not None
    return found.second.range_mm > 0


def wall(distance: float, width: float, height: float = 20.0) -> Mesh:
    """Return a wall across x whose face is at a distance."""
    return box(0.2, width, height, Material.RENDER).placed(distance + 0.1, 0, -5)


def normal_range(found: SimulatedScan) -> np.ndarray:
    """Return the distance of first returns along x [m], of beams ahead and nearly so."""
    beams = beams_of(sensor_info(LidarMode.COLUMNS_1024, dual=True))
    xyz = beams.offset + found.first.range_mm[..., None] * 1e-3 * beams.direction
    return xyz[..., 0][(found.first.range_mm > 0) & (xyz[..., 0] > np.abs(2.5 * xyz[..., 1]))]


def test_an_edge_before_a_far_wall_gives_two_returns_one_of_either_wall() -> None:
    found = scan(WIDE, wall(10.0, 4.0), wall(20.0, 60.0))
    two = seconds(found)
    assert found.second is not None
    assert 50 < two.sum() < 0.05 * (found.first.range_mm > 0).sum()
    pairs = np.stack([found.first.object_id[two], found.second.object_id[two]])
    assert (np.sort(pairs, axis=0) == np.array([[0], [1]])).all()
    assert (found.first.object_id[two] == 0).mean() > 0.9  # the nearer is four times as strong
    x = normal_range(found)
    assert (np.minimum(np.abs(x - 10.0), np.abs(x - 20.0)) < 0.2).all()


def test_an_edge_before_a_near_wall_gives_mixed_pixels_between_the_two() -> None:
    for config, expected in ((WIDE, True), (EXACT, False)):
        found = scan(config, wall(10.0, 4.0), wall(10.2, 20.0))
        x = normal_range(found)
        assert x.min() > 9.94
        assert x.max() < 10.26
        between = (x > 10.05) & (x < 10.15)
        assert (between.sum() > 20) if expected else not between.any()
        assert not seconds(found).any()


def test_level_ground_gives_one_return_however_slanting() -> None:
    found = scan(WIDE, box(300, 300, 1.0, Material.CONCRETE).placed(0, 0, -1))
    assert (found.first.range_mm > 0).sum() > 30_000
    assert seconds(found).sum() < 5e-4 * (found.first.range_mm > 0).sum()


@pytest.mark.parametrize("config", [WIDE, EXACT])
def test_a_wire_lets_light_by_to_the_wall_behind_it(config: LidarConfig) -> None:
    wires = Wires(30.0, height=3.0, sag=0.2).mesh().placed(8.0, -15.0, 0.0, np.pi / 2)
    found = scan(config, wires, wall(14.0, 60.0))
    assert found.second is not None
    two = seconds(found) & (found.first.object_id == 0)
    assert two.sum() > 100
    assert (found.second.object_id[two] == 1).mean() > 0.8  # the others meet the next line


def test_no_second_return_where_it_is_switched_off() -> None:
    wires = Wires(30.0, height=3.0, sag=0.2).mesh().placed(8.0, -15.0, 0.0, np.pi / 2)
    off = EXACT.model_copy(update={"second_return": 0.0})
    assert not seconds(scan(off, wires, wall(14.0, 60.0))).any()
    assert scan(WIDE, wires, wall(14.0, 60.0), dual=False).second is None


@pytest.mark.parametrize("normal", [(0, 0, 1.0), (0.8, 0.6, 0.0), (0.5, -0.5, 0.7)])
def test_no_beam_on_a_plane_is_at_an_edge_and_all_beside_a_step_are(normal: tuple[float, ...]) -> None:
    direction = beams_of(sensor_info(LidarMode.COLUMNS_1024, dual=False)).direction
    towards = direction @ np.array(normal)
    with np.errstate(divide="ignore"):
        distance = np.where(towards > 0.02, 2.0 / towards, np.inf)
    inside = (towards > 0.05).ravel()
    edges = Neighbours(direction).at_edges(distance)
    assert not inside[edges].any()
    nearer = distance.copy()
    nearer[:, 400:500] *= 0.7
    stepped = np.setdiff1d(Neighbours(direction).at_edges(nearer), edges)
    assert {399, 400, 499, 500} <= set((stepped % 1024).tolist())


def hits(*distance: float) -> Hits:
    count = len(distance)
    return Hits(np.array(distance), np.arange(count), np.zeros(count, np.uint8), np.ones(count))


def test_two_samples_merge_weighted_by_their_light_or_part_with_half_of_it() -> None:
    one, other = hits(10.0, 10.0, 10.0, np.inf), hits(10.2, 20.0, np.inf, np.inf)
    strength = (np.array([3.0, 1.0, 1.0, 0.0]), np.array([1.0, 4.0, 0.0, 0.0]))
    first, second = merge(one, other, strength, 1e-3)
    np.testing.assert_allclose(first.hits.distance, [10.05, 20.0, 10.0, np.inf])
    np.testing.assert_allclose(second.hits.distance, [np.inf, 10.0, np.inf, np.inf])
    np.testing.assert_allclose(first.share, [1.0, 0.5, 0.5, 0.5])
    assert PARTING < 1.0


def test_glass_swallows_the_share_of_beams_that_is_asked_for() -> None:
    pane = box(0.2, 10.0, 6.0, Material.GLASS).placed(6.0, 0, -1)
    counts = {
        share: (scan(EXACT.model_copy(update={"glass": share}), pane).first.range_mm > 0).sum()
        for share in (0.0, 0.25, 1.0)
    }
    assert counts[1.0] == 0
    assert counts[0.25] / counts[0.0] == pytest.approx(0.75, abs=0.03)


def test_intensity_falls_with_the_cosine_of_incidence() -> None:
    found = scan(EXACT, wall(10.0, 60.0))
    beams = beams_of(sensor_info(LidarMode.COLUMNS_1024, dual=True))
    back = found.first.range_mm > 0
    cosine = beams.direction[..., 0][back]
    lambert = REFLECTIVITY[Material.RENDER] * (0.03 + 0.97 * cosine)
    assert cosine.min() < 0.5
    assert np.abs(found.first.reflectivity[back] - 100 * lambert).max() <= 1.0

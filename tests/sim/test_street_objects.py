"""Known dimensions of roofs, buildings, vehicles, street objects and plants, and known beam angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.frames import Floats
from subiaco_sim.config import LidarMode
from subiaco_sim.families.buildings import ARCADE_HEIGHT, PASSAGE, Annexe, Building, CourtBlock
from subiaco_sim.families.foliage import Crown, Profile, Season, dressed, seasons_of
from subiaco_sim.families.roofs import Roof
from subiaco_sim.families.street_objects import Container, MarketStall, Oddment, Scaffolding, StreetLamp
from subiaco_sim.families.vehicles import Bus, Caravan, Motorcycle, Van, random_vehicle
from subiaco_sim.lidar import beams_of
from subiaco_sim.packets import true_sensor_info
from subiaco_sim.plants import Tree
from subiaco_sim.primitives import Mesh
from subiaco_sim.scene import VEGETATION, Item, Placed, compile_meshes
from subiaco_sim.sensors import SENSORS, SensorName, row_shift


def extent(mesh: Mesh) -> Floats:
    """Return the size of the box about a mesh (3,) [m]."""
    return np.asarray(mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0))


def top(mesh: Mesh) -> float:
    return float(mesh.vertices[:, 2].max())


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        (Bus(), (12.0, 2.55, 3.1)),
        (Van(5.6, 2.0, 2.6), (5.6, 2.0, 2.6)),
        (Container(), (6.06, 2.44, 2.59)),
        (Caravan(4.6, 2.2, 2.5), (4.6 / 2 + 4.6 / 2 + 1.2, 2.2, 2.5)),
    ],
)
def test_vehicles_and_containers_have_the_size_they_say(
    shape: Bus | Van | Container | Caravan, size: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(extent(shape.mesh()), size, atol=0.08)
    assert shape.mesh().vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_a_motorcycle_is_as_high_as_it_says_and_narrower_than_a_car() -> None:
    size = extent(Motorcycle(2.1, 1.2).mesh())
    assert size[2] == pytest.approx(1.2, abs=0.02)
    assert size[1] < 0.9


def test_vans_are_2_4_to_2_8_m_high() -> None:
    rng = np.random.default_rng(1)
    vans = [v for v in (random_vehicle(rng) for _ in range(600)) if isinstance(v, Van)]
    heights = [van.height for van in vans]
    assert len(vans) > 60
    assert min(heights) >= 2.4
    assert max(heights) <= 2.8
    assert max(heights) - min(heights) > 0.3


@pytest.mark.parametrize("roof", Roof)
def test_a_roof_rises_as_far_above_the_eaves_as_it_says(roof: Roof) -> None:
    house = Building(10.0, 8.0, 5.7, roof, 2.1)
    assert top(house.mesh()) == pytest.approx(7.8, abs=1e-9)
    assert house.top == pytest.approx(7.8)


@pytest.mark.parametrize(("roof", "low"), [(Roof.GABLE, True), (Roof.HIP, True), (Roof.MANSARD, False)])
def test_a_mansard_is_high_near_its_eaves_and_a_hip_is_low(roof: Roof, low: bool) -> None:
    house = Building(10.0, 8.0, 5.7, roof, 3.0, overhang=0.0)
    eye = np.array([[0.0, -3.0, 20.0]])  # 1 m behind the front wall
    hit = compile_meshes([(1, house.mesh())]).cast(eye, np.array([[0.0, 0.0, -1.0]]))
    above = 20.0 - float(hit.distance[0]) - 5.7
    assert (above < 1.0) == low


def test_an_arcade_is_open_up_to_its_height_between_its_columns() -> None:
    house = Building(13.6, 10.0, 12.0, Roof.FLAT, 0.5, arcade=2.5)
    scene = compile_meshes([(1, house.mesh())])
    eye, inward = np.array([[1.7, -12.0, 1.7]]), np.array([[0.0, 1.0, 0.0]])
    assert scene.cast(eye, inward).distance[0] == pytest.approx(12.0 - 5.0 + 2.5, abs=0.15)
    above = eye + np.array([[0.0, 0.0, ARCADE_HEIGHT]])
    assert scene.cast(above, inward).distance[0] == pytest.approx(7.0, abs=0.15)


def test_the_court_of_a_block_can_be_seen_through_its_passage_only() -> None:
    block = CourtBlock(18.0, 30.0, 12.0, Roof.FLAT, 0.7)
    scene = compile_meshes([(1, block.mesh())])
    inward = np.array([[0.0, 1.0, 0.0]])
    through = scene.cast(np.array([[0.0, -20.0, 1.7]]), inward).distance[0]
    beside = scene.cast(np.array([[PASSAGE[0], -20.0, 1.7]]), inward).distance[0]
    assert through == pytest.approx(5.0 + 30.0 - 9.0, abs=0.01)  # the front of the rear wing
    assert beside == pytest.approx(5.0, abs=0.05)


@given(st.floats(2.4, 20.0), st.floats(4.0, 20.0), st.floats(0.0, 0.4))
def test_the_volume_of_a_building_is_that_of_its_walls_and_annexes(
    eaves: float, width: float, share: float
) -> None:
    annexe = Annexe(0.0, 0.0, share * width, 10.0, 0.0, eaves)
    house = Building(width, 10.0, eaves, Roof.FLAT, 0.3, annexes=(annexe,))
    assert house.volume == pytest.approx((1.0 + share) * width * 10.0 * eaves)


def test_scaffolding_stalls_and_lamps_are_as_high_as_they_say() -> None:
    assert top(Scaffolding(10.0, 9.0).mesh()) == pytest.approx(9.0)
    assert top(MarketStall(3.0, 2.2, 2.5).mesh()) == pytest.approx(2.5, abs=0.2)
    assert top(StreetLamp(5.5).mesh()) == pytest.approx(5.5)


@given(st.integers(0, 2**31 - 1), st.floats(0.6, 2.4))
def test_a_thing_of_no_kind_stays_within_its_size(form: int, size: float) -> None:
    mesh = Oddment(form, size).mesh()
    assert mesh.vertices[:, 2].min() >= 0.0
    assert np.all(extent(mesh) < 2.0 * size)
    np.testing.assert_array_equal(mesh.vertices, Oddment(form, size).mesh().vertices)


@pytest.mark.parametrize("profile", Profile)
def test_a_crown_is_as_high_and_wide_as_it_says(profile: Profile) -> None:
    plant = Crown(profile, 8.0, 2.0, 6.0, 0.15, 5, 6, density=4.0)
    vertices = plant.mesh().vertices
    assert vertices[:, 2].max() == pytest.approx(8.0, abs=0.25)
    reach = np.percentile(np.hypot(*vertices[:, :2].T), 99)
    assert 1.4 < reach < 2.6


def test_leaves_and_lean_are_those_of_the_epoch_and_the_form_stays() -> None:
    tree = Tree(8.0, 2.5, 5.0, 0.17, 1, 2)
    rng = np.random.default_rng(4)
    seasons = (Season(1.2, 0.3), Season(0.4, 0.1))
    ratios = []
    for number in range(80):
        item = dressed(
            Item(number, "street tree", VEGETATION, Placed(tree, 0, 0), Placed(tree, 0, 0)), seasons, rng
        )
        assert item.before is not None
        assert item.after is not None
        first, second = item.before.shape, item.after.shape
        assert isinstance(first, Tree)
        assert isinstance(second, Tree)
        assert first.solid() == second.solid()
        assert first.leaves != second.leaves
        assert 0.0 <= first.sway <= 0.3
        assert 0.0 <= second.sway <= 0.1
        ratios.append(first.density / second.density)
    assert np.median(ratios) == pytest.approx(2.2, abs=0.8)
    assert np.std(np.log(ratios)) > 0.3  # every plant has a factor of its own


@given(st.integers(0, 10_000))
def test_the_fuller_epoch_has_at_most_three_times_the_leaves(seed: int) -> None:
    seasons = seasons_of(None, 0.3, np.random.default_rng(seed))
    ratio = max(s.density for s in seasons) / min(s.density for s in seasons)
    assert 1.0 <= ratio <= 3.0
    assert all(0.0 < season.sway <= 0.3 for season in seasons)


@pytest.mark.parametrize(
    ("name", "beams", "highest", "lowest"),
    [
        (SensorName.OS1_128, 128, 20.95, -21.82),
        (SensorName.OS1_64, 64, 16.611, -16.611),
        (SensorName.OS0_32, 32, 43.88, -45.4),
        (SensorName.HDL_32E, 32, 10.67, -30.66),
    ],
)
def test_the_rays_of_a_sensor_have_its_beam_angles(
    name: SensorName, beams: int, highest: float, lowest: float
) -> None:
    info = true_sensor_info(LidarMode.COLUMNS_512, False, SENSORS[name])
    direction = beams_of(info).direction
    assert direction.shape == (beams, 512, 3)
    elevation = np.degrees(np.arcsin(direction[..., 2]))[:, 0]
    np.testing.assert_allclose(elevation, SENSORS[name].elevation_deg, atol=0.01)
    assert elevation[0] == pytest.approx(highest, abs=0.01)
    assert elevation[-1] == pytest.approx(lowest, abs=0.01)
    assert np.all(np.diff(elevation) < 0)


def test_the_rows_of_a_column_look_one_way_once_they_are_shifted() -> None:
    for sensor in SENSORS.values():
        shift = np.array(row_shift(sensor, 1024))
        left = sensor.azimuth_deg - shift * 360.0 / 1024
        assert np.ptp(left) <= 360.0 / 1024 + 1e-9
    assert row_shift(SENSORS[SensorName.OS1_128], 1024)[:4] == [24, 16, 8, 0]

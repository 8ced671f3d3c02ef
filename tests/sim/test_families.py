"""Streets of both families: what is built there, what happens, and magnitudes that no gate divides."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest

from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_sim.config import SimulationConfig
from subiaco_sim.drives import plan_survey
from subiaco_sim.families.buildings import Building
from subiaco_sim.families.config import Family, StreetConfig
from subiaco_sim.families.events import QUOTAS, RISE, SHARE
from subiaco_sim.families.plan import StreetPlan, plan_street
from subiaco_sim.families.roofs import Roof
from subiaco_sim.families.vehicles import Bus
from subiaco_sim.ground import ROAD_HALF
from subiaco_sim.labels import ground_change, true_change
from subiaco_sim.presets import build_family_scene, preset_hash, with_preset
from subiaco_sim.scene import BUILDING, MOBILE, Placed, Scene, item_mesh, laid_mesh
from subiaco_sim.sensors import SENSORS, SensorName

SEEDS = range(101, 107)


@cache
def scene_of(preset: str, seed: int, **street: float) -> Scene:
    config = SimulationConfig(preset=preset, seed=seed, ground_cell=2.0, street=StreetConfig(**street))
    return build_family_scene(with_preset(config))


@pytest.fixture(scope="module", params=[Family.SUBURB, Family.DENSE])
def family(request: pytest.FixtureRequest) -> Family:
    """Return a family of streets."""
    return Family(request.param)


@pytest.fixture(scope="module")
def scenes(family: Family) -> list[Scene]:
    """Return six streets of a family."""
    return [scene_of(family, seed) for seed in SEEDS]


def buildings(scenes: list[Scene]) -> list[Building]:
    placed = [item.before or item.after for scene in scenes for item in scene.items]
    return [p.shape for p in placed if p is not None and isinstance(p.shape, Building)]


def kinds(scenes: list[Scene]) -> Counter[str]:
    return Counter(item.kind for scene in scenes for item in scene.items)


def test_a_street_follows_from_its_seed_alone(family: Family) -> None:
    assert scene_of(family, 101).items == scene_of.__wrapped__(family, 101).items
    assert scene_of(family, 101).items != scene_of(family, 102).items


def test_ids_count_up_without_a_gap(scenes: list[Scene]) -> None:
    for scene in scenes:
        ids = [i.object_id for i in (*scene.items, *scene.ground_items, *scene.moving)]
        assert ids == list(range(1, len(ids) + 1))


def test_roofs_of_many_forms_stand_on_a_street(family: Family, scenes: list[Scene]) -> None:
    found = Counter(building.roof for building in buildings(scenes))
    assert {Roof.FLAT, Roof.HIP, Roof.GABLE, Roof.MANSARD} <= set(found)
    if family is Family.DENSE:
        assert np.median([b.eaves for b in buildings(scenes)]) > 10.0


def test_things_that_no_rule_knows_stand_on_a_street(family: Family, scenes: list[Scene]) -> None:
    found = kinds(scenes)
    common = {"container", "scaffolding", "oddment", "motorcycle", "long vehicle", "bus"}
    own = {
        Family.SUBURB: {"retaining wall", "flats", "unit", "house", "skip", "cabinet"},
        Family.DENSE: {"stall", "terrace", "court block", "town house", "pillar", "monument", "workshop"},
    }[family]
    assert common | own <= set(found)


def test_arcades_stand_on_either_street(scenes: list[Scene]) -> None:
    assert any(building.arcade > 0 for building in buildings(scenes))


def setbacks(family: Family) -> list[float]:
    """Return how far behind the building line the fronts of the houses of a family stand [m]."""
    found = []
    for seed in SEEDS:
        plan, scene = plan_of(family, seed), scene_of(family, seed)
        line = ROAD_HALF + plan.widen + plan.footway
        for item in scene.items:
            placed = item.before or item.after
            if item.kind in ("house", "town house") and placed and isinstance(placed.shape, Building):
                gap = float(np.linalg.norm(scene.route - (placed.x, placed.y), axis=1).min())
                found.append(gap - line - placed.shape.depth / 2)
    return found


def test_a_dense_street_has_no_front_gardens_and_some_houses_of_a_suburb_have_none() -> None:
    assert np.mean(np.array(setbacks(Family.DENSE)) < 1.5) > 0.8
    assert 0.05 < np.mean(np.array(setbacks(Family.SUBURB)) < 1.5) < 0.5


def plan_of(family: Family, seed: int, *, hard: bool = False) -> StreetPlan:
    return plan_street(family, hard=hard, config=StreetConfig(), seed=seed)


def test_sensors_lanes_sides_and_directions_differ_from_seed_to_seed(family: Family) -> None:
    plans = [plan_of(family, seed) for seed in range(200)]
    assert {SENSORS[name].beams for plan in plans for name in plan.sensors} == {32, 64, 128}
    assert {plan.reverse_after for plan in plans} == {True, False}
    assert {plan.lane for plan in plans} >= {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert {plan.side for plan in plans} == {1 if family is Family.SUBURB else -1}
    steepness = [np.hypot(*plan.slope) for plan in plans]
    assert max(steepness) > 0.08
    assert min(steepness) < 0.01


def test_a_hard_street_is_steep_up_to_twelve_per_cent_and_its_sensors_differ(family: Family) -> None:
    plans = [plan_of(family, seed, hard=True) for seed in range(100)]
    steepness = [np.hypot(*plan.slope) for plan in plans]
    assert 0.07 <= min(steepness) < max(steepness) <= 0.12
    assert max(steepness) > 0.115
    assert all(plan.sensors[0] is not plan.sensors[1] for plan in plans)


@pytest.mark.parametrize(("preset", "side"), [("suburb", 1.0), ("dense", -1.0)])
def test_a_drive_keeps_to_its_side_of_the_street(preset: str, side: float) -> None:
    config = {"preset": preset, "seed": 103, "duration": 6.0, "ground_cell": 2.0, "mode": "512x10"}
    survey = plan_survey(SimulationConfig.model_validate(config | {"reverse_after": False}))
    motion = survey.drives["before"].motion.position
    place, way = motion(4.0)[:2], motion(4.0, 1)[:2]
    k = int(np.linalg.norm(survey.scene.route - place, axis=1).argmin())
    off = place - survey.scene.route[k]
    assert np.sign(way[0] * off[1] - way[1] * off[0]) == side


def test_what_is_asked_for_wins_over_what_the_seed_draws() -> None:
    asked = SimulationConfig(
        preset="dense", seed=101, sensor_before="os0-32", beams_after=64, reverse_after=False, lane_after=0
    )
    config = with_preset(asked)
    assert config.sensor_before is SensorName.OS0_32
    assert config.sensor_after is None
    assert config.beams_after == 64
    assert config.reverse_after is False


def test_settings_of_a_street_are_refused_by_other_presets() -> None:
    with pytest.raises(InputError, match="street: preset default"):
        with_preset(SimulationConfig(preset="default", street=StreetConfig(slope=0.1)))


def test_presets_of_families_have_hashes_of_their_own() -> None:
    names = ("suburb", "suburb_hard", "dense", "dense_hard")
    assert len({preset_hash(name) for name in names}) == 4


def gates_crossed(values: list[float], low: float, high: float, bins: int) -> bool:
    """Tell whether magnitudes fill every bin of a range."""
    return bool(np.all(np.histogram(np.abs(values), bins=bins, range=(low, high))[0] > 0))


def test_rises_of_the_ground_pass_through_their_gate() -> None:
    works = [w for f in Family for s in SEEDS for w in scene_of(f, s).ground_items]
    assert gates_crossed([w.patch.rise for w in works], *RISE, bins=6)
    assert gates_crossed([w.patch.area for w in works], 12.0, 60.0, bins=5)
    labels = Counter(ground_change(w) for w in works)
    assert min(labels[c] for c in (Change.UNCHANGED, Change.INCREASED, Change.DECREASED)) > 5


@pytest.mark.parametrize(("kind", "gate"), [("house", 0.10), ("street tree", 0.15)])
def test_true_shares_of_volume_lie_on_both_sides_of_their_gate_and_beside_it(kind: str, gate: float) -> None:
    shares = []
    for seed in SEEDS[:3]:
        scene = scene_of("suburb", seed)
        for item in scene.items:
            if item.kind == kind and item.event and item.before and item.after and item.event != "re-clad":
                true = true_change(item, scene)
                assert true.before is not None
                shares.append(abs(true.delta_v) / true.before.volume)
    near = np.abs(np.array(shares) - gate) < 0.05
    assert min(np.sum(np.array(shares) < gate), np.sum(np.array(shares) > gate)) > 2
    assert near.sum() > 1
    assert np.max(shares) > 0.8 * SHARE[1]


def changed_share(scenes: list[Scene], kind: str) -> float:
    items = [item for scene in scenes for item in scene.items if item.kind == kind]
    return float(np.mean([bool(item.event) for item in items]))


def test_activity_scales_how_much_happens() -> None:
    still = [scene_of("suburb", seed, activity=0.0) for seed in (101, 102)]
    assert not any(item.event for scene in still for item in scene.items)
    assert not any(scene.ground_items for scene in still)
    usual = [scene_of("suburb", seed) for seed in (101, 102)]
    assert changed_share(usual, "car") == pytest.approx(0.88, abs=0.15)


def test_shares_of_events_leave_something_alone() -> None:
    for quotas in QUOTAS.values():
        assert 0.0 < sum(share for _, share in quotas) < 1.0


def test_what_lies_on_sloping_land_follows_it_and_a_house_stands_level() -> None:
    land = scene_of("suburb", 101, slope=0.1).terrain
    bus, house = Bus(), Building(8.0, 8.0, 3.0, Roof.FLAT, 0.3)
    place = (0.0, 0.0, float(np.arctan2(*land.slope[::-1])))  # along the line of steepest rise
    lying = laid_mesh(Placed(bus, *place), MOBILE, land).vertices
    level = item_mesh(Placed(bus, *place), MOBILE, land).vertices
    assert np.ptp(lying[:, 2] - level[:, 2]) == pytest.approx(0.1 * 12.0, abs=0.02)
    np.testing.assert_array_equal(lying[:, :2], level[:, :2])
    standing = laid_mesh(Placed(house, *place), BUILDING, land).vertices
    np.testing.assert_array_equal(standing, item_mesh(Placed(house, *place), BUILDING, land).vertices)


def test_raised_lots_lie_above_the_street_by_their_rise_and_a_wall_holds_them() -> None:
    for seed in SEEDS:
        scene = scene_of("suburb", seed)
        land = scene.terrain
        lots = land.raised  # type: ignore[attr-defined]
        walls = [item for item in scene.items if item.kind == "retaining wall"]
        assert len(walls) == len(lots)
        for lot, wall in zip(lots, walls, strict=True):
            placed = wall.before
            assert placed is not None
            height = placed.shape.height  # type: ignore[attr-defined]
            assert lot.rise <= height <= lot.rise + 0.4
            assert not lot.contains(np.array([placed.x]), np.array([placed.y]))[0]
            flat = land.height_at(lot.x, lot.y) - type(land)(
                land.road, land.bounds, land.slope, land.cell
            ).height_at(lot.x, lot.y)
            assert flat == pytest.approx(lot.rise)

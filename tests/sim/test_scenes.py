"""Where objects are on crowded streets: bays, lanes, gates, twin crowns; and a city's shared streets."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from shapely.geometry import Point, Polygon

from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, make_pose
from subiaco_sim.buildings import House
from subiaco_sim.city import BLOCK
from subiaco_sim.config import SimulationConfig, TruthConfig
from subiaco_sim.drives import plan_survey
from subiaco_sim.furniture import Car, Truck
from subiaco_sim.ground import Line, Road, Terrain
from subiaco_sim.labels import ground_change, true_change
from subiaco_sim.plants import Tree
from subiaco_sim.presets import build_scene
from subiaco_sim.primitives import Material
from subiaco_sim.scene import EPOCHS, MOBILE, GroundItem, Item, Placed, Scene, compile_scene
from subiaco_sim.scene_config import Character, SceneConfig
from subiaco_sim.seeing import OtherDrive, seen_from
from subiaco_sim.suburb import rectangle

SEEDS = (101, 102, 103, 104)
#: Everything that is asked of the two crowded presets.
EVENTS = {
    *("added", "removed", "extended", "wing added", "wing demolished", "storey added", "partly demolished"),
    *("re-roofed", "two sheds became one", "grown", "pruned", "grown together", "cut apart"),
    *("hedge trimmed", "hedge grown", "another vehicle", "moved"),
}
WORKS = {
    *("resurfaced", "milled", "settled", "cambered", "excavated", "filled", "small pit", "shallow fill"),
    *("yard excavated", "yard filled"),
}


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Return scenes of both crowded presets (tuning seeds) on a coarse ground."""
    return [build_scene(name, seed, ground_cell=2.0) for name in ("default", "hard") for seed in SEEDS]


def items_of(scenes: list[Scene], *kinds: str) -> list[tuple[Scene, Item]]:
    """Return all items of some kinds, each with its scene."""
    return [(scene, item) for scene in scenes for item in scene.items if item.kind in kinds]


def footprint(placed: Placed) -> Polygon:
    """Return the outline of a vehicle."""
    assert isinstance(placed.shape, Car | Truck)
    return rectangle(placed.x, placed.y, placed.yaw, placed.shape.length, placed.shape.width)


def at_kerb(scene: Scene, placed: Placed) -> bool:
    """Tell whether a vehicle stands beside the kerb rather than on a drive."""
    gap = np.linalg.norm(scene.route - (placed.x, placed.y), axis=1).min()
    return bool(gap < scene.terrain.road.widen + 3.7)


def test_everything_that_should_happen_happens(scenes: list[Scene]) -> None:
    assert {item.event for scene in scenes for item in scene.items} >= EVENTS
    assert {item.event for scene in scenes for item in scene.ground_items} >= WORKS
    assert any(i.kind == "terrace middle" and i.after is None for s in scenes for i in s.items)


def test_cars_at_the_kerb_stand_in_marked_bays(scenes: list[Scene]) -> None:
    checked = 0
    for scene in scenes:
        bays = [line for line in scene.terrain.lines if line.length == 6.5]
        sides = [line for line in scene.terrain.lines if line.length == 2.1]
        assert len(sides) == 2 * len(bays) > 20
        middles = np.array([(line.x, line.y) for line in bays])
        for item in scene.items:
            if item.kind == "car" and item.before and at_kerb(scene, item.before):
                gap = np.hypot(*(middles - (item.before.x, item.before.y)).T).min()
                assert gap == pytest.approx(1.05, abs=1e-6)  # half a bay from its line
                checked += 1
    assert checked > 100


@pytest.mark.parametrize("epoch", EPOCHS)
def test_no_two_vehicles_at_the_kerb_touch(scenes: list[Scene], epoch: str) -> None:
    for scene in scenes:
        parked = [p for i in scene.items if i.semantic == MOBILE and (p := i.at(epoch)) and at_kerb(scene, p)]
        outlines = [footprint(placed) for placed in parked]
        assert not any(a.intersects(b) for k, a in enumerate(outlines) for b in outlines[:k])


def test_paint_lies_on_the_road_and_has_the_area_of_its_lines() -> None:
    road = Road(np.column_stack([np.linspace(-20, 20, 161), np.zeros(161)]))
    bare = Terrain(road, (-20, -10, 20, 10), (0.03, 0.0), 1.0)
    mesh = replace(bare, lines=(Line(1.0, 2.0, 0.3, 3.0), Line(-5.0, 0.0, 0.0, 2.0))).mesh()
    paint = mesh.material == Material.PAINT
    assert mesh.areas()[paint].sum() == pytest.approx(5.0 * 0.12, rel=0.01)
    corners = mesh.corners()[paint].reshape(-1, 3)
    np.testing.assert_allclose(corners[:, 2] - bare.height(corners[:, 0], corners[:, 1]), 0.008, atol=1e-9)


def plan(**asked: object) -> tuple[Scene, dict[str, Floats], dict[str, Floats]]:
    """Return the scene of a short survey of preset hard, and middle place and way of both drives."""
    config = {"preset": "hard", "seed": 101, "duration": 5.0, "mode": "512x10", "ground_cell": 2.0}
    survey = plan_survey(SimulationConfig.model_validate(config | asked))
    motion = {epoch: drive.motion.position for epoch, drive in survey.drives.items()}
    places = {epoch: position(4.0)[:2] for epoch, position in motion.items()}
    return survey.scene, places, {epoch: position(4.0, 1)[:2] for epoch, position in motion.items()}


@pytest.mark.parametrize(("asked", "lanes"), [({}, (0, 1)), ({"lane_before": 1, "lane_after": 0}, (1, 0))])
def test_every_drive_keeps_to_its_lane(asked: dict[str, int], lanes: tuple[int, int]) -> None:
    scene, places, _ = plan(**asked)
    for epoch, lane in zip(EPOCHS, lanes, strict=True):
        gap = np.linalg.norm(scene.route - places[epoch], axis=1).min()
        assert gap == pytest.approx(1.7 + 3.3 * lane, abs=0.05)


@pytest.mark.parametrize("reverse", [True, False])
def test_traffic_comes_against_a_drive_whichever_way_it_goes(reverse: bool) -> None:
    scene, _, ways = plan(reverse_after=reverse)
    assert (ways["before"] @ ways["after"] < 0) == reverse
    vehicles = [m for m in scene.moving if m.radius > 3]
    assert all(m.speed > 0 if reverse and m.epoch == "after" else m.speed < 0 for m in vehicles)  # type: ignore[attr-defined]


def test_a_lane_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="lane_after 2: there are 2 each way"):
        plan(lane_after=2)


def test_hard_climbs_by_five_and_a_half_to_eight_per_cent() -> None:
    slopes = [abs(build_scene("hard", seed, ground_cell=2.0).terrain.slope[0]) for seed in range(101, 121)]
    assert all(0.055 <= slope <= 0.08 for slope in slopes)
    assert max(slopes) > 0.07


def hidden_share(scene: Scene, item: GroundItem) -> float:
    """Return the share of a patch that a drive along the street cannot see."""
    near = np.argsort(np.linalg.norm(scene.route - (item.patch.x, item.patch.y), axis=1))[:200:8]
    z = scene.terrain.height(*scene.route[near].T) + 2.0
    poses = make_pose(np.tile(np.eye(3), (len(near), 1, 1)), np.column_stack([scene.route[near], z]))
    view = OtherDrive(compile_scene(scene, "before"), poses, 60.0)
    west, south, east, north = item.patch.outline().bounds
    x, y = (v.ravel() for v in np.meshgrid(np.arange(west, east, 0.3), np.arange(south, north, 0.3)))
    inside = item.patch.contains(x, y)
    places = np.column_stack([x, y, scene.terrain.height(x, y)])[inside]
    ids = np.zeros(len(places), dtype=np.int64)
    return 1.0 - float(seen_from(view, places, ids, ids[:0], TruthConfig()).mean())


def test_what_is_dug_behind_a_gate_is_hidden_by_it(scenes: list[Scene]) -> None:
    found = [(s, g) for s in scenes for g in s.ground_items if g.event.startswith("yard")]
    assert len(found) > 4
    assert {ground_change(g) for _, g in found} == {Change.INCREASED, Change.DECREASED}
    hidden, open_ = [], []
    for scene, item in found[:4]:
        hidden.append(hidden_share(scene, item))
        without = replace(scene, items=tuple(i for i in scene.items if i.kind != "gate"))
        open_.append(hidden_share(without, item))
    assert np.mean(hidden) > np.mean(open_) + 0.2


def test_sheds_come_and_go_behind_gates(scenes: list[Scene]) -> None:
    behind = 0
    for scene in scenes:
        gates = np.array([(i.before.x, i.before.y) for i in scene.items if i.kind == "gate" and i.before])
        for item in scene.items:
            placed = item.before or item.after
            if item.kind == "shed" and item.event and placed:
                behind += np.hypot(*(gates - (placed.x, placed.y)).T).min() < 11.0
    assert behind >= 3


def test_cars_and_ground_change_under_crowns_that_stay(scenes: list[Scene]) -> None:
    cars = ground = 0
    for scene, tree in items_of(scenes, "street tree"):
        if tree.event or tree.after is None:
            continue
        assert isinstance(tree.after.shape, Tree)
        crown = Point(tree.after.x, tree.after.y).buffer(0.8 * tree.after.shape.radius)
        ground += any(
            ground_change(g) != Change.UNCHANGED and g.patch.outline().intersects(crown)
            for g in scene.ground_items
        )
        changed = [i.before or i.after for i in scene.items if i.kind == "car" and not (i.before and i.after)]
        cars += any(footprint(p).intersects(crown) for p in changed if p)
    assert cars > 5
    assert ground > 5


@pytest.mark.parametrize(
    ("kind", "event", "change"),
    [
        ("twin tree", "grown together", Change.INCREASED),
        ("joined tree", "cut apart", Change.DECREASED),
    ],
)
def test_crowns_of_twins_meet_and_part(scenes: list[Scene], kind: str, event: str, change: Change) -> None:
    twins = items_of(scenes, kind)
    happened = 0
    for (scene, one), (_, other) in zip(twins[::2], twins[1::2], strict=True):
        gaps = {}
        for epoch in EPOCHS:
            a, b = one.at(epoch), other.at(epoch)
            assert a
            assert b
            reach = a.shape.radius + b.shape.radius  # type: ignore[attr-defined]
            gaps[epoch] = float(np.hypot(a.x - b.x, a.y - b.y)) - reach
        assert (gaps["before"] > 0) == (kind == "twin tree")
        assert one.event == other.event
        if one.event == event:
            assert gaps["after"] == pytest.approx(-0.6 if kind == "twin tree" else 0.5, abs=1e-6)
            assert {true_change(item, scene).change for item in (one, other)} == {change}
            happened += 1
    assert happened > 5


def test_a_new_roof_has_another_cladding_and_the_same_height_and_is_no_change(scenes: list[Scene]) -> None:
    found = [(s, i) for s, i in items_of(scenes, "house") if i.event == "re-roofed"]
    assert found
    for scene, item in found:
        assert item.before
        assert item.after
        old, new = item.before.shape, item.after.shape
        assert isinstance(old, House)
        assert isinstance(new, House)
        assert (old.storeys, old.pitch, old.roof) == (new.storeys, new.pitch, new.roof)
        assert old.cover != new.cover
        assert true_change(item, scene).change == Change.UNCHANGED


def test_shares_of_events_and_the_street_itself_are_settings() -> None:
    asked = SceneConfig(
        character=Character(gates=0.0), shares={"bin": {"added": 1.0, "removed": 0, "moved": 0}}
    )
    scene = build_scene("default", 101, 2.0, asked=asked)
    assert {i.event for i in scene.items if i.kind == "bin"} == {"added"}
    assert not any(i.kind == "gate" for i in scene.items)
    usual = build_scene("default", 101, 2.0, asked=SceneConfig())
    assert usual.items == build_scene("default", 101, 2.0).items


@pytest.mark.parametrize(
    ("shares", "message"),
    [
        ({"bin": {"eaten": 0.1}}, "eaten is not one of added, removed, moved"),
        ({"boat": {"added": 0.1}}, "scene.shares.boat"),
        ({"bin": {"added": 0.9}}, "at most 1 in all"),
    ],
)
def test_shares_that_cannot_be_are_refused(shares: dict[str, dict[str, float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        build_scene("default", 101, 2.0, asked=SceneConfig(shares=shares))


def test_a_clean_street_has_no_settings_of_a_crowded_one() -> None:
    config = SimulationConfig(preset="easy", scene=SceneConfig(character=Character(gates=0.0)))
    with pytest.raises(InputError, match="take a crowded preset"):
        plan_survey(config)


@pytest.mark.parametrize("other", [1, 5])
def test_loops_of_a_city_share_the_street_between_them(other: int) -> None:
    """Loop 0 and its neighbour to the east or north: one ground, and the same things in sight of both."""
    one, next_ = (build_scene("city", 101, 2.0, loop=loop) for loop in (0, other))
    bounds = [np.array(scene.terrain.bounds) for scene in (one, next_)]
    low = np.maximum(bounds[0][:2], bounds[1][:2]) + 3.0
    high = np.minimum(bounds[0][2:], bounds[1][2:]) - 3.0

    def shared(scene: Scene) -> list[Item]:
        def within(item: Item) -> bool:
            return all(
                np.all(low < (p.x, p.y)) and np.all((p.x, p.y) < high) for p in (item.before, item.after) if p
            )

        key = [replace(item, object_id=0) for item in scene.items if within(item)]
        return sorted(key, key=repr)

    assert shared(one) == shared(next_)
    assert len(shared(one)) > 60
    x, y = np.random.default_rng(1).uniform(low, high, (500, 2)).T
    np.testing.assert_allclose(one.terrain.height(x, y), next_.terrain.height(x, y), atol=1e-9)
    east = other == 1
    crown = np.array([BLOCK[0] / 2, 0.0]) if east else np.array([0.0, BLOCK[1] / 2])
    for scene in (one, next_):
        assert np.linalg.norm(scene.route - crown, axis=1).min() < 0.2


def test_crossings_are_roads_and_no_house_stands_on_one() -> None:
    scene = build_scene("city", 101, 2.0, loop=6)
    column, row = 1, 1
    corner = np.array([(column + 0.5) * BLOCK[0], (row + 0.5) * BLOCK[1]])
    arms = [corner + np.array(step) for step in ((0, 0), (20, 0), (-20, 0), (0, 20), (0, -20))]
    assert np.all(scene.terrain.road.distance(*np.array(arms).T) < 0.2)
    for item in scene.items:
        placed = item.before or item.after
        if placed and isinstance(placed.shape, House):
            gap = float(scene.terrain.road.distance(np.array([placed.x]), np.array([placed.y]))[0])
            assert gap > 10.0


def test_ids_of_a_loop_count_up_without_a_gap() -> None:
    scene = build_scene("city", 101, 2.0, loop=3)
    ids = [*(i.object_id for i in scene.items), *(g.object_id for g in scene.ground_items)]
    ids += [m.object_id for m in scene.moving]
    assert all(b == a + 1 for a, b in pairwise([0, *ids]))

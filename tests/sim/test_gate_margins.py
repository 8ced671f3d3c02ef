"""A change is near a gate exactly where its uncertainty reaches over the gate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.codes import Change
from subiaco_sim.families.buildings import Building
from subiaco_sim.families.roofs import Roof
from subiaco_sim.gate_margins import Uncertainty, ground_near_gate, near_gate, near_gates, uncertainty_of
from subiaco_sim.ground import Patch, Road, Terrain
from subiaco_sim.labels import Body, TrueChange, decide, label_scene, true_change
from subiaco_sim.plants import Tree
from subiaco_sim.scene import BUILDING, MOBILE, OTHER, VEGETATION, GroundItem, Item, Placed, Scene

HOUSE = Building(10.0, 8.0, 5.7, Roof.FLAT, 0.3)
TREE = Tree(8.0, 2.5, 5.0, 0.17, 1, 2)


def scene_with(*items: Item, ground: tuple[GroundItem, ...] = ()) -> Scene:
    route = np.column_stack([np.linspace(-30, 30, 241), np.full(241, -20.0)])
    land = Terrain(Road(route), (-30, -30, 30, 30), (0.0, 0.0), 2.0)
    return Scene(land, items, ground, route)


def house_raised_by(rise: float) -> Item:
    before, after = Placed(HOUSE, 0.0, 0.0), Placed(replace(HOUSE, eaves=HOUSE.eaves + rise), 0.0, 0.0)
    return Item(1, "house", BUILDING, before, after, "roof raised")


@pytest.mark.parametrize(
    ("rise", "near"), [(0.1, False), (0.47, True), (0.53, True), (0.9, False), (3.0, False)]
)
def test_a_raised_roof_is_near_the_gate_of_half_a_metre_only_beside_it(rise: float, near: bool) -> None:
    scene = scene_with(house_raised_by(rise))
    labels = label_scene(scene)
    assert labels.measured[1].delta_h == pytest.approx(rise, abs=0.01)
    assert near_gates(scene, labels) == ({1} if near else set())


def test_a_share_of_the_volume_beside_ten_per_cent_is_near_the_gate() -> None:
    found = {}
    for share in (0.04, 0.10, 0.25):
        before = Placed(HOUSE, 0.0, 0.0)
        item = Item(1, "house", BUILDING, before, Placed(replace(HOUSE, cut=share * 10.0), 0.0, 0.0))
        scene = scene_with(item)
        found[share] = near_gates(scene, label_scene(scene))
    assert found == {0.04: set(), 0.10: {1}, 0.25: set()}


def test_what_stays_or_comes_or_goes_is_never_near_a_gate() -> None:
    place = Placed(HOUSE, 0.0, 0.0)
    scene = scene_with(
        Item(1, "house", BUILDING, place, place),
        Item(2, "house", BUILDING, None, replace(place, x=20.0)),
        Item(3, "tree", VEGETATION, Placed(TREE, -15.0, 0.0), None),
        Item(
            4,
            "tree",
            VEGETATION,
            Placed(TREE, -15.0, 9.0),
            Placed(replace(TREE, leaves=9, density=0.3), -15.0, 9.0),
        ),
    )
    assert near_gates(scene, label_scene(scene)) == set()


def test_the_volume_of_a_crown_is_known_less_well_than_that_of_a_house() -> None:
    crown = Item(1, "tree", VEGETATION, Placed(TREE, 0, 0), Placed(replace(TREE, radius=2.6), 0, 0))
    house = house_raised_by(0.3)
    found = [
        uncertainty_of(item, scene_with(item), true_change(item, scene_with(item))) for item in (house, crown)
    ]
    assert found[0].share < found[1].share < 0.06
    assert 0.03 <= found[0].height < found[1].height < 0.3


@pytest.mark.parametrize(
    ("rise", "area", "near"),
    [
        (0.30, 60.0, False),
        (0.14, 60.0, True),
        (-0.17, 60.0, True),
        (0.08, 60.0, False),
        (0.3, 26.0, True),
        (0.3, 12.0, False),
    ],
)
def test_ground_works_are_near_a_gate_by_rise_or_area(rise: float, area: float, near: bool) -> None:
    assert ground_near_gate(GroundItem(1, Patch(0, 0, area / 3.0, 3.0, 0.0, rise), "")) == near


def body(volume: float) -> Body:
    return Body(np.zeros(1, dtype=np.int64), np.array([volume / 0.25]), np.zeros(3))


@given(
    st.sampled_from([BUILDING, VEGETATION, MOBILE, OTHER]),
    st.floats(-1.0, 1.0),
    st.floats(-0.5, 0.5),
    st.floats(0.0, 3.0),
    st.floats(0.05, 1.0),
)
def test_a_change_that_is_not_near_a_gate_keeps_its_label_within_its_uncertainty(
    semantic: int, height: float, share: float, moved: float, iou: float
) -> None:
    uncertainty = Uncertainty(0.03, 0.02, 0.05, 0.02)
    label = decide(semantic, height, 100 * share, share, moved, iou)
    true = TrueChange(label, body(100.0), body(100.0), height, 100.0 * share, moved, iou)
    if near_gate(semantic, true, uncertainty):
        return
    rng = np.random.default_rng(3)
    for h, v, c, o in rng.uniform(-2.0, 2.0, (40, 4)):
        other = share + v * uncertainty.share
        again = decide(
            semantic,
            height + h * uncertainty.height,
            100 * other,
            other,
            max(0.0, moved + c * uncertainty.centroid),
            min(1.0, iou + o * uncertainty.iou),
        )
        assert again == label
    assert label in (Change.INCREASED, Change.DECREASED, Change.UNCHANGED, Change.NOT_REPORTED)

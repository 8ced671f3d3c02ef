"""Crowded streets: what they hold, what changes on them, and what only looks like it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from subiaco_geo.codes import Change
from subiaco_sim.config import SimulationConfig
from subiaco_sim.drives import Survey, plan_survey
from subiaco_sim.events import QUOTAS
from subiaco_sim.ground import FOOTPATH, KERB_HEIGHT, ROAD_HALF, Road, Terrain, strip_along
from subiaco_sim.labels import GROUND_AREA, Labels, label_scene
from subiaco_sim.movers import freeze
from subiaco_sim.plants import Hedge, Palm, Tree
from subiaco_sim.presets import build_scene, preset_hash, simulator_hash
from subiaco_sim.primitives import Material, box
from subiaco_sim.scene import BUILDING, MOBILE, OTHER, VEGETATION, Scene, compile_meshes

#: What is often too little for the thresholds, and then Unchanged.
SMALL = {"hedge trimmed", "hedge grown", "wing added", "wing demolished"}
QUIET = {"", "another vehicle", "moved", "re-roofed", "settled", "cambered", "shallow fill", "small pit"}


@pytest.fixture(scope="module", params=["default", "hard"])
def street(request: pytest.FixtureRequest) -> tuple[Scene, Labels]:
    """Return a scene (seed 101) on a coarse ground, and its labels."""
    scene = build_scene(request.param, 101, ground_cell=2.0)
    return scene, label_scene(scene)


def test_every_label_occurs_in_every_class_that_has_it(street: tuple[Scene, Labels]) -> None:
    scene, labels = street
    found = {k: set() for k in (BUILDING, VEGETATION, MOBILE, OTHER)}
    for item in scene.items:
        found[item.semantic].add(Change(int(labels.change[item.object_id])))
    every = {Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED, Change.UNCHANGED}
    assert found[BUILDING] == found[VEGETATION] == every
    assert {Change.ADDED, Change.REMOVED, Change.UNCHANGED} <= found[MOBILE]
    assert {Change.ADDED, Change.REMOVED, Change.UNCHANGED} <= found[OTHER]
    ground = {Change(int(labels.change[g.object_id])) for g in scene.ground_items}
    assert ground == {Change.INCREASED, Change.DECREASED, Change.UNCHANGED}


def test_only_events_that_should_change_something_do(street: tuple[Scene, Labels]) -> None:
    scene, labels = street
    for item in [*scene.items, *scene.ground_items]:
        changed = labels.change[item.object_id] < Change.UNCHANGED
        if item.event in QUIET:
            assert not changed, item.event
        elif item.event not in SMALL:
            assert changed, (item.event, labels.measured.get(item.object_id))


def test_seasons_renew_leaves_thin_crowns_and_bend_them_without_a_change(
    street: tuple[Scene, Labels],
) -> None:
    scene, labels = street
    quiet = [
        i for i in scene.items if not i.event and isinstance(i.before and i.before.shape, Tree | Palm | Hedge)
    ]
    assert len(quiet) > 20
    assert all(labels.change[item.object_id] == Change.UNCHANGED for item in quiet)
    assert all(i.before.shape.leaves != i.after.shape.leaves for i in quiet)  # type: ignore[union-attr]
    thinned = [i for i in quiet if i.after.shape.density < 0.5]  # type: ignore[union-attr]
    assert thinned


def test_strips_are_a_metre_wide_at_least_and_tell_more_than_25_m2(street: tuple[Scene, Labels]) -> None:
    scene, labels = street
    strips = [g for g in scene.ground_items if g.event in {"resurfaced", "milled"}]
    assert strips
    for item in strips:
        assert labels.change[item.object_id] in {Change.INCREASED, Change.DECREASED}
        assert item.patch.area > GROUND_AREA
        assert 0.20 <= abs(item.patch.rise) <= 0.50


def test_no_ground_patches_overlap(street: tuple[Scene, Labels]) -> None:
    outlines = [g.patch.outline() for g in street[0].ground_items]
    assert not any(a.intersects(b) for k, a in enumerate(outlines) for b in outlines[:k])


def test_the_same_seed_gives_the_same_street_and_another_one_another() -> None:
    first, again, other = (build_scene("default", seed, ground_cell=2.0) for seed in (7, 7, 8))
    assert first.items == again.items
    assert first.moving == again.moving
    assert first.items != other.items


def test_quotas_never_ask_for_more_than_there_is() -> None:
    assert all(sum(share for _, share in quotas) <= 1.0 for quotas in QUOTAS.values())


def test_a_strip_follows_its_line_and_holds_exactly_what_lies_in_it() -> None:
    line = np.column_stack([np.arange(0, 60, 0.25), np.zeros(240)])
    strip = strip_along(line, 20, 181, 3.0, 1.2, 0.3)
    assert strip.area == pytest.approx(40.0 * 1.2)
    inside = strip.contains(np.array([25.0, 25.0, 25.0, 4.0]), np.array([2.5, 3.5, 3.7, 3.0]))
    assert inside.tolist() == [True, True, False, False]


def test_a_wider_road_keeps_its_kerb_and_a_median_stands_as_high() -> None:
    line = np.column_stack([np.linspace(-50, 50, 401), np.zeros(401)])
    terrain = Terrain(Road(line, widen=1.3, median=0.4), (-50, -20, 50, 20), (0.0, 0.0), 1.0)
    x = np.zeros(4)
    y = np.array([0.0, 1.0, ROAD_HALF + 1.3 + 0.1, FOOTPATH[1] + 1.3])
    height = terrain.height(x, y) - 0.35 * np.sin(0.5) * np.cos(y / 37.0)
    edge = -0.025 * ROAD_HALF
    np.testing.assert_allclose(
        height, [KERB_HEIGHT, 0.0, edge + KERB_HEIGHT, edge + KERB_HEIGHT + 0.06], atol=0.003
    )


@pytest.fixture(scope="module")
def survey() -> Survey:
    """Return a plan of two short drives (seed 101) on a coarse ground."""
    return plan_survey(
        SimulationConfig(preset="default", seed=101, duration=5.0, mode="512x10", ground_cell=2.0)
    )


def test_the_earlier_drive_has_64_beams_and_goes_the_other_way(survey: Survey) -> None:
    before, after = survey.drives["before"], survey.drives["after"]
    assert (before.info.h, after.info.h) == (64, 128)
    ways = [d.motion.position(np.array([4.0]), 1)[0, :2] for d in (before, after)]
    assert ways[0] @ ways[1] < 0


def test_a_mover_hides_what_stands_behind_it_and_is_gone_a_little_later(survey: Survey) -> None:
    scene = survey.scene
    mover = next(m for m in scene.moving if m.radius > 3)
    terrain = scene.terrain_at("before")
    wall = compile_meshes([(1, box(200.0, 200.0, 0.1, Material.BRICK).placed(0, 0, -40.0))])

    def seen(seconds: float) -> int:
        x, y, _ = mover.at(scene.route, 3.0)
        eye = np.array([x, y, 30.0])
        now = freeze(wall, [replace(mover)], terrain, scene.route, seconds, eye)
        hits = now.cast(eye[None], np.array([[0.0, 0.0, -1.0]]))
        return int(hits.object_id[0])

    assert seen(3.0) == mover.object_id
    assert seen(6.0) == 1


def test_what_moves_is_mobile_and_not_reported(survey: Survey) -> None:
    labels = label_scene(survey.scene)
    ids = [m.object_id for m in survey.scene.moving]
    assert set(labels.change[ids]) == {Change.NOT_REPORTED}
    assert set(labels.semantic[ids]) == {MOBILE}


def test_the_recording_vehicle_keeps_clear_of_what_is_parked(survey: Survey) -> None:
    for epoch, drive in survey.drives.items():
        path = drive.lidar_poses(drive.scan_end_ns())[:, :3, 3]
        gap = drive.compiled.distance_to_surface(path)
        assert gap.min() > 0.6, epoch


def test_hashes_name_the_simulator_and_the_preset() -> None:
    assert len(simulator_hash()) == 16
    assert preset_hash("default") == preset_hash("default")
    assert len({preset_hash(name) for name in ("easy", "default", "hard")}) == 3


def test_kinds_of_things_are_many() -> None:
    kinds = Counter(i.kind for seed in (101, 102) for i in build_scene("hard", seed, ground_cell=2.0).items)
    wanted = {
        "house",
        "terrace middle",
        "shop",
        "apartments",
        "shed",
        "street tree",
        "palm",
        "hedge",
        "shrub",
    }
    wanted |= {"car", "truck", "pole", "wires", "sign", "bin", "bus shelter", "fence", "wall", "gate"}
    assert wanted <= set(kinds)

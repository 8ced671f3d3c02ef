"""Known changes put into a made-up street: the truth is exact, and what is hidden is hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from subiaco_evaluation.injection.config import InjectionConfig, RepeatConfig, SightConfig
from subiaco_evaluation.injection.edits import (
    Donor,
    Edited,
    Put,
    compare_columns,
    cut_off,
    grown,
    grown_plant,
    put_object,
    raise_ground,
    reshape,
    take_away,
)
from subiaco_evaluation.injection.inject import inject, read_donors
from subiaco_evaluation.injection.occlusion import Sight
from subiaco_evaluation.injection.second_pass import edit_visibility, resampled
from subiaco_evaluation.injection.site import Site
from subiaco_evaluation.injection.truth_writing import write_injected
from subiaco_evaluation.score_files import evaluation_markdown
from subiaco_evaluation.scoring import evaluate
from subiaco_evaluation.truth import read_truth
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.maps import load_epoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.voxel_traversal import VisibilityAccumulator

ORIGIN = np.array([391_000.0, 6_464_000.0, 20.0])
LEAF = 0.25
POSES = np.column_stack([np.arange(2.0, 58.0, 1.0), np.full(56, 10.0), np.full(56, 2.0)])


def plane(low, high, axis, at):
    """Points every 0.25 m on a plane across an axis."""
    spans = [np.arange(a + 0.125, b, LEAF) for a, b in zip(low, high, strict=True)]
    spans[axis] = np.array([at])
    return np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 3)


def box(x, y, width, height):
    """Walls and roof of a box that stands on the ground."""
    low, high = (x, y, 0.0), (x + width, y + width, height)
    sides = [plane(low, high, axis, at) for axis in (0, 1) for at in (low[axis], high[axis])]
    return np.concatenate([*sides, plane(low, high, 2, height)])


def street():
    """A street 60 m long, drive along y = 10; a house at (20, 16), a shed at (40, 3)."""
    ground = plane((0, 0, 0), (60, 30, 0.1), 2, 0.0)
    house, shed = box(20, 16, 6, 5), box(40, 3, 3, 2.5)
    under = [
        (ground[:, 0] > x) & (ground[:, 0] < x + w) & (ground[:, 1] > y) & (ground[:, 1] < y + w)
        for x, y, w in ((20, 16, 6), (40, 3, 3))
    ]
    ground = ground[~(under[0] | under[1])]
    xyz = np.concatenate([ground, house, shed])
    sizes = [len(ground), len(house), len(shed)]
    semantic = np.repeat([Semantic.GROUND, Semantic.BUILDING, Semantic.BUILDING], sizes).astype(np.uint8)
    instance = np.repeat([-1, 0, 1], sizes).astype(np.int32)
    return xyz, semantic, instance


def edited(**settings):
    xyz, semantic, instance = street()
    config = InjectionConfig(min_points=20, **settings)
    sight = Sight.of_drive(POSES, SightConfig())
    return Edited(
        xyz, semantic, instance, sight, Site.of_map(xyz, semantic), config, np.random.default_rng(7)
    )


def test_a_wall_beside_the_road_hides_what_is_behind_it_and_nothing_else():
    sight = Sight.of_drive(POSES, SightConfig())
    wall = plane((0, 14, 0), (60, 14, 6), 1, 14.0)
    points = np.array([[30.0, 18.0, 1.0], [30.0, 12.0, 0.0], [30.0, 2.0, 1.0], [30.0, 18.0, 14.0]])
    assert sight.hidden(points, wall).tolist() == [True, False, False, False]


def test_a_post_hides_nothing_that_another_pose_sees_past_it():
    sight = Sight.of_drive(POSES, SightConfig())
    post = np.column_stack([np.full((12, 1), 30.0), np.full((12, 1), 13.0), np.arange(0, 3, LEAF)])
    assert not sight.hidden(np.array([[30.0, 20.0, 1.0]]), post).any()


def test_the_far_side_of_what_is_put_is_not_seen():
    sight = Sight.of_drive(POSES, SightConfig())
    near, far = plane((15, 14, 0), (45, 14, 3), 1, 14.0), plane((28, 16, 0), (32, 16, 3), 1, 16.0)
    both = np.concatenate([near, far])
    seen = sight.seen(both, both)
    assert seen[: len(near)].mean() > 0.95
    assert seen[len(near) :].mean() < 0.05


def test_what_is_taken_away_leaves_no_ground_behind_it():
    scene = edited()
    shed = np.flatnonzero(scene.instance == 1)
    take_away(scene, shed, "building")
    assert scene.gone[shed].all()
    assert scene.gone.sum() == len(shed)
    assert set(scene.change[shed]) == {Change.REMOVED}
    assert set(scene.change[~scene.gone]) == {Change.UNCHANGED}
    assert scene.rows[0]["label"] == "Removed"


def test_what_is_put_stands_on_free_ground_and_turns_its_known_side_to_the_drive():
    scene = edited()
    side = plane((-1.5, -0.125, 0), (1.5, 0.125, 1.5), 1, 0.0)
    car = Donor("mobile", Semantic.MOBILE, side, np.full(len(side), -1), facing=np.pi / 2)
    assert put_object(scene, car)
    put = scene.put[0].xyz
    assert put[:, 2].min() == pytest.approx(0.125, abs=0.02)
    standing = scene.xyz[scene.semantic == Semantic.BUILDING]
    gap = np.linalg.norm(standing[:, None, :2] - put[None, ::7, :2], axis=2).min()
    assert gap > scene.config.clearance
    assert np.ptp(put[:, 0]) > 5 * np.ptp(put[:, 1])  # alongside the road, as the donor stood


def test_growth_and_cuts_have_the_truth_of_their_columns():
    tree = box(-1.0, -1.0, 2.0, 4.0)
    assert compare_columns(tree, grown(tree, 1.5, LEAF))[0] == pytest.approx(2.0, abs=0.3)
    assert np.diff(np.unique(grown(tree, 1.5, LEAF)[:, 2])).max() < 1.2 * LEAF, "no gaps"
    assert compare_columns(tree, cut_off(tree, 0.5))[0] == pytest.approx(-2.0, abs=0.3)
    plant = grown_plant(tree, 1.5, LEAF)
    assert np.ptp(plant, axis=0) == pytest.approx([2.5, 2.5, 6.0], abs=0.3)
    assert compare_columns(tree, plant)[2] > 0.5
    assert compare_columns(tree, grown(tree, 0.7, LEAF))[0] == pytest.approx(-1.2, abs=0.3)
    scene = edited()
    shed = np.flatnonzero(scene.instance == 1)
    reshape(scene, shed, "building", lambda p: grown(p, 1.4, LEAF), "grown")
    assert scene.put[0].change == Change.INCREASED
    assert set(scene.change[shed]) == {Change.INCREASED}
    assert scene.rows[0]["delta_h_m"] == pytest.approx(1.0, abs=0.2)


def test_a_thing_of_which_only_the_top_was_seen_is_not_cut():
    scene = edited()
    roof = np.flatnonzero((scene.instance == 1) & (scene.xyz[:, 2] > 2.3))
    assert not reshape(scene, roof, "vegetation", lambda p: cut_off(p, 0.5), "cut")
    assert not scene.rows
    assert not scene.gone.any()


def test_what_is_cut_hides_nothing_and_what_has_grown_hides_what_its_new_part_covers():
    for change, hides in ((lambda p: cut_off(p, 0.4), False), (lambda p: grown(p, 1.6, LEAF), True)):
        scene = edited()
        behind = np.array([[41.5, 1.0, 3.9]])  # seen over the shed, not over one that is 1.5 m higher
        scene.xyz = np.concatenate([scene.xyz, behind])
        extra = {"semantic": np.uint8(4), "instance": np.int32(-1)}
        scene = Edited(
            scene.xyz,
            *(np.append(getattr(scene, name), value) for name, value in extra.items()),
            scene.sight, scene.site, scene.config, np.random.default_rng(7),
        )  # fmt: skip
        reshape(scene, np.flatnonzero(scene.instance == 1), "building", change, "any")
        assert scene.hidden[-1] == hides
        assert scene.hidden.any() == hides


@pytest.mark.parametrize(
    ("size", "rise", "change"),
    [
        ((12.0, 4.0), 0.3, Change.INCREASED),
        ((12.0, 4.0), -0.3, Change.DECREASED),
        ((12.0, 4.0), 0.1, Change.UNCHANGED),
        ((6.0, 3.0), 0.3, Change.UNCHANGED),
    ],
)
def test_a_ground_patch_moves_its_ground_and_counts_from_the_published_size_on(size, rise, change):
    scene = edited()
    assert raise_ground(scene, np.array([30.0, 10.0]), 0.0, size, rise)
    moved = scene.rise != 0
    assert np.ptp(scene.xyz[moved][:, 0]) == pytest.approx(size[0], abs=0.3)
    assert np.ptp(scene.xyz[moved][:, 1]) == pytest.approx(size[1], abs=0.3)
    assert set(scene.rise[moved]) == {rise}
    assert set(scene.change[moved]) == {change}


def test_ground_under_a_house_is_not_moved():
    scene = edited()
    assert not raise_ground(scene, np.array([22.0, 15.0]), 0.0, (10.0, 6.0), 0.3)
    assert not scene.rows


def test_beams_pass_where_a_thing_was_and_end_where_one_stands():
    scene = edited()
    starts = np.repeat(POSES[::6], 40, axis=0)
    rng = np.random.default_rng(2)
    ends = scene.xyz[rng.choice(len(scene.xyz), len(starts))]
    ends = np.concatenate([ends, scene.xyz[scene.instance == 1]])
    starts = np.concatenate([starts, np.tile(POSES[38], (len(ends) - len(starts), 1))])
    beams = VisibilityAccumulator(ORIGIN - 5.0, 0.5)
    beams.add(starts + ORIGIN, ends + ORIGIN)
    grid = beams.grid()
    shed = np.flatnonzero(scene.instance == 1)
    take_away(scene, shed, "building")
    wall = plane((10, 13, 0), (50, 13, 5), 1, 13.0)
    unknown = np.full(len(wall), -1)
    scene.stand(Put(wall, unknown, 2, Semantic.BUILDING, Change.ADDED, wall))
    copy = edit_visibility(grid, ORIGIN, scene)
    roof = np.array([[41.4, 4.4, 2.5]]) + ORIGIN
    assert grid.lookup(roof)[0][0] > 0
    hits, passes = copy.lookup(roof)
    assert hits[0] == 0
    assert passes[0] > 0
    behind = np.array([[30.0, 20.0, 0.1]]) + ORIGIN
    assert not copy.observed(behind).any()
    assert len(copy.keys) < len(grid.keys)


@pytest.fixture(scope="module")
def survey():
    xyz, _, _ = street()
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (len(POSES), 1, 1))
    poses[:, :3, 3] = POSES + ORIGIN
    times = np.arange(len(POSES), dtype=np.int64) * 10**8
    cloud = PointCloud(xyz + rng.normal(0, 0.01, xyz.shape), ORIGIN, "EPSG:7850")
    return SurveyMap(cloud, Trajectory(times, poses))


SMALL = InjectionConfig(
    seed=4, inserted=3, removed=1, moved=0, grown=1, cut=0, patches=2, min_points=60, scale=(0.5, 0.8)
)


def test_a_map_and_its_copy_differ_by_the_edits_alone_and_the_seed_repeats_them(survey):
    first, second = inject(survey, SMALL), inject(survey, SMALL)
    np.testing.assert_array_equal(first.after.cloud.xyz, second.after.cloud.xyz)
    asked = SMALL.inserted + SMALL.removed + SMALL.grown + SMALL.patches
    assert len(first.rows) + sum(first.left_out.values()) == asked
    untouched = first.after.cloud.fields["object"] == 0
    assert set(first.after.cloud.fields["change"][untouched]) == {Change.UNCHANGED}
    before = first.before.cloud
    share = untouched.sum() / (before.fields["object"] == 0).sum()
    assert 0.7 < share <= 1.0  # what is hidden is missing; what is missed is made up for elsewhere


def test_without_noise_or_edits_the_copy_is_the_map(survey):
    nothing = dict.fromkeys(("inserted", "removed", "moved", "grown", "cut", "patches"), 0)
    config = InjectionConfig(repeat=RepeatConfig(sigma=0.0, again=1.0, wander=0.0, foliage=0.0), **nothing)
    injected = inject(survey, config)
    np.testing.assert_allclose(injected.after.cloud.xyz, injected.before.cloud.xyz)
    assert set(injected.before.cloud.fields["change"]) == {Change.UNCHANGED}


def test_a_second_pass_misses_what_few_beams_hit_and_stays_on_the_surfaces():
    floor = plane((0, 0, 0), (40, 40, 0.1), 2, 0.0)
    count = np.tile([1, 2, 8], len(floor) // 3 + 1)[: len(floor)]
    fields = {"n": count, "semantic": np.zeros(len(floor), dtype=np.uint8)}
    config = InjectionConfig(repeat=RepeatConfig(again=0.5, sigma=0.0, uneven=np.inf))
    chosen, moved = resampled(floor, fields, config, np.random.default_rng(3))
    assert len(chosen) == len(floor)
    again = chosen[: np.flatnonzero(np.diff(chosen) <= 0)[0] + 1]  # in order; then those hit instead
    met = np.bincount(again, minlength=len(floor)) > 0
    assert [met[count == n].mean() for n in (1, 2)] == pytest.approx([0.5, 0.75], abs=0.02)
    step = moved - floor[chosen]
    assert np.abs(step[:, 2]).max() < 1e-9, "along the floor"
    kept = np.linalg.norm(step, axis=1)[count[chosen] == 8]
    assert np.median(kept) == pytest.approx(1.18 * LEAF / np.sqrt(12 * 8), rel=0.1)
    leaves = fields | {"semantic": np.full(len(floor), Semantic.VEGETATION, dtype=np.uint8)}
    chosen, other = resampled(floor, leaves, config, np.random.default_rng(3))
    apart = np.linalg.norm(other - floor[chosen], axis=1)
    assert 0.1 < np.median(apart) < apart.max() < config.repeat.foliage + 0.05
    assert np.abs(other[:, :2].min(axis=0)).max() < 0.3, "the outline stays"
    assert np.abs(other[:, :2].max(axis=0) - 40.0).max() < 0.3


def test_a_copy_that_comes_first_has_the_opposite_truth(survey):
    one_way = inject(survey, SMALL)
    other = one_way.turned_round()
    labels = [(str(a["label"]), str(b["label"])) for a, b in zip(one_way.rows, other.rows, strict=True)]
    pairs = {
        ("Added", "Removed"),
        ("Removed", "Added"),
        ("Increased", "Decreased"),
        ("Decreased", "Increased"),
    }
    assert {pair for pair in labels if "Unchanged" not in pair} <= pairs
    assert len(set(labels)) >= 3
    np.testing.assert_array_equal(other.before.cloud.xyz, one_way.after.cloud.xyz)
    put, taken = one_way.after.cloud.fields["change"], other.before.cloud.fields["change"]
    assert set(taken[put == Change.ADDED]) == {Change.REMOVED}
    assert set(taken[put == Change.UNOBSERVED]) <= {Change.UNOBSERVED}
    for a, b in zip(one_way.rows, other.rows, strict=True):
        assert b.get("delta_h_m", 0.0) == -a.get("delta_h_m", 0.0)


def test_an_injected_map_is_a_map_with_the_truth_of_a_simulated_survey(survey, tmp_path):
    injected = inject(survey, SMALL)
    write_injected(tmp_path / "copy", tmp_path / "map", injected, SMALL)
    copy = load_epoch(tmp_path / "copy")
    assert copy.info["injected"]["seed"] == 4
    assert not {"object", "change", "semantic"} & set(copy.cloud.fields)
    truth = read_truth(tmp_path / "copy")
    assert len(truth.objects) == len(injected.rows)
    assert len(truth.after) == len(copy.cloud)
    labels = {int(i): c for i, c in zip(truth.objects["object_id"], truth.objects["change"], strict=True)}
    for cloud in (truth.before, truth.after):
        for number in np.unique(cloud.fields["object"]):
            if number:
                codes = set(cloud.fields["change"][cloud.fields["object"] == number])
                assert codes <= {labels[int(number)], Change.UNOBSERVED}


def test_objects_come_from_a_folder_by_the_names_of_their_files(tmp_path):
    for name in ("tree_1", "lamp"):
        write_cloud(tmp_path / f"{name}.ply", PointCloud(box(5, 5, 1, 3), np.zeros(3), None))
    donors = read_donors(tmp_path, LEAF)
    assert [(d.kind, d.semantic) for d in donors] == [
        ("lamp", Semantic.OTHER),
        ("tree_1", Semantic.VEGETATION),
    ]
    assert np.abs(donors[0].xyz[:, :2].mean(axis=0)).max() < 0.1
    with pytest.raises(InputError, match="holds no object clouds"):
        read_donors(tmp_path / "none", LEAF)


def test_a_map_without_a_drive_is_refused(survey):
    with pytest.raises(InputError, match="no trajectory"):
        inject(replace(survey, trajectory=None), SMALL)


def test_scores_of_injected_changes_say_what_they_are(survey, tmp_path):
    injected = inject(survey, SMALL)
    write_injected(tmp_path / "copy", tmp_path / "map", injected, SMALL)
    labels = tmp_path / "labels"
    labels.mkdir()
    for epoch, cloud in (("before", injected.before.cloud), ("after", injected.after.cloud)):
        np.save(labels / f"{epoch}.npy", cloud.fields["change"])
    result = evaluate([(labels, tmp_path / "copy")])
    assert result["changes_are_injected"] is True
    assert result["simulations"] == []
    assert result["points"]["accuracy_percent"] == 100.0
    assert "injected changes" in evaluation_markdown(result)

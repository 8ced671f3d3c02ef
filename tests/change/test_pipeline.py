"""Known changes in a small street, from two clouds to the table and the labelled points."""

import numpy as np
import pytest
from scenes import Scene, ground_z

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_geo.clouds import PointCloud, voxel_indices, voxel_keys
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.visibility import VisibilityGrid

IDENTITY = np.eye(4)


def strip(x, y):
    """A resurfaced strip of 1.5 m x 30 m, and a camber of 0.1 m that is none."""
    return 0.25 * ((abs(y + 4.75) < 0.75) & (abs(x) < 15)) + 0.10 * ((y > 3) & (y < 6))


BEFORE = Scene(
    houses=[(-22, 13), (-8, 13), (8, 13), (22, 13)],
    trees=[(-8, -13), (0, -13), (8, -13, 5.0, 1.5)],
    cars=[(-15, 0), (0, 0)],
)
AFTER = Scene(
    houses=[(-22, 13), (8, 13, 10, 8, 8.0), (19.5, 13, 5, 8), (-22, -13)],
    trees=[(-8, -13), (8, -13, 7.5, 2.5), (17, -13)],
    cars=[(-15, 0.1, 4.6, 1.85), (12, 1)],
    lift=strip,
)


def seen_everywhere(hidden=None, points=None):
    """A visibility layer in which ten beams passed everywhere but in a hidden box (low, high).

    Ten more were returned from each voxel that holds points (N, 3).
    """
    low, high = np.array([-34.0, -24.0, -4.0]), np.array([34.0, 24.0, 14.0])
    axes = [np.arange(a, b, 0.5) + 0.25 for a, b in zip(low, high, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if hidden is not None:
        centres = centres[~((centres > hidden[0]) & (centres < hidden[1])).all(axis=1)]
    keys = np.sort(voxel_keys(voxel_indices(centres - low, 0.5)))
    tens = np.full(len(keys), 10, dtype=np.uint32)
    held = np.zeros(0) if points is None else voxel_keys(voxel_indices(points - low, 0.5))
    return VisibilityGrid(low, 0.5, keys, np.where(np.isin(keys, held), tens, 0).astype(np.uint32), tens)


def survey(scene, seed, hidden=None):
    cloud = scene.survey(seed).cloud
    return SurveyMap(cloud, visibility=seen_everywhere(hidden, cloud.world()))


@pytest.fixture(scope="module")
def result():
    return detect_changes(survey(BEFORE, 1), survey(AFTER, 2), ChangeConfig(), transform=IDENTITY)


def at(result, semantic, x, y, reach=3.0):
    """The record of a class whose centre is near a place."""
    found = [r for r in result.records if r.semantic is semantic and np.hypot(r.x - x, r.y - y) < reach]
    assert len(found) == 1, [(r.semantic.label, r.change.label, round(r.x, 1), round(r.y, 1)) for r in found]
    return found[0]


@pytest.mark.parametrize(
    ("x", "y", "change"),
    [
        (-22, 13, Change.UNCHANGED),
        (-8, 13, Change.REMOVED),
        (8, 13, Change.INCREASED),
        (21, 13, Change.DECREASED),
        (-22, -13, Change.ADDED),
    ],
)
def test_houses_are_removed_raised_shortened_and_added(result, x, y, change):
    assert at(result, Semantic.BUILDING, x, y).change is change


def test_a_new_house_has_a_height_after_and_a_removed_one_a_height_before(result):
    built, removed = at(result, Semantic.BUILDING, -22, -13), at(result, Semantic.BUILDING, -8, 13)
    assert 2.5 < built.height_after_m < 9.0
    assert np.isnan(built.height_before_m)
    assert 2.5 < removed.height_before_m < 9.0
    assert np.isnan(removed.height_after_m)


def test_a_storey_of_three_metres_measures_three_metres(result):
    assert at(result, Semantic.BUILDING, 8, 13).delta_h_m == pytest.approx(3.0, abs=0.3)


def test_half_a_house_loses_half_of_its_volume(result):
    record = at(result, Semantic.BUILDING, 21, 13)
    assert record.delta_v_m3 == pytest.approx(-5 * 8 * 5, rel=0.25)


@pytest.mark.parametrize(
    ("x", "y", "change"),
    [
        (-8, -13, Change.UNCHANGED),
        (0, -13, Change.REMOVED),
        (8, -13, Change.INCREASED),
        (17, -13, Change.ADDED),
    ],
)
def test_trees_are_felled_grown_and_planted(result, x, y, change):
    assert at(result, Semantic.VEGETATION, x, y).change is change


@pytest.mark.parametrize(
    ("x", "y", "change"),
    [(-15, 0, Change.UNCHANGED), (0, 0, Change.REMOVED), (12, 1, Change.ADDED)],
)
def test_another_car_in_the_same_place_is_unchanged(result, x, y, change):
    assert at(result, Semantic.MOBILE, x, y).change is change


def test_a_resurfaced_strip_is_found_and_a_camber_is_not(result):
    ground = [r for r in result.records if r.semantic is Semantic.GROUND]
    assert [r.change for r in ground] == [Change.INCREASED]
    assert ground[0].delta_h_m == pytest.approx(0.25, abs=0.03)
    assert ground[0].footprint.area == pytest.approx(45.0, rel=0.2)
    assert ground[0].y == pytest.approx(-4.75, abs=0.3)


@pytest.mark.parametrize("epoch", ["before", "after"])
def test_points_carry_the_displacement_of_their_surface_and_its_significance(result, epoch):
    cloud = getattr(result, epoch)
    fields = {name: np.asarray(values) for name, values in cloud.fields.items()}
    distance, significant = fields["m3c2_distance"], fields["m3c2_significant"] == 1
    assert np.array_equal(np.isnan(distance), np.isinf(fields["lod95"]))
    known = np.isfinite(distance)
    assert np.array_equal(significant[known], (np.abs(distance) > fields["lod95"])[known])
    assert not significant[~known].any()
    patch = next(r for r in result.records if r.semantic == Semantic.GROUND)
    strip = known & (fields["instance"] == patch.object_id)
    middle = strip & (np.abs(cloud.world()[:, 1] - patch.y) < 0.4)
    covered = 0.857  # share of the cylinder of 1 m on the strip of 1.5 m
    assert np.median(distance[middle]) == pytest.approx(0.25 * covered, abs=0.02)
    assert significant[strip].mean() > 0.9
    still = known & (fields["semantic"] == Semantic.GROUND) & (cloud.world()[:, 1] < -7.0)
    assert still.sum() > 1000
    assert significant[still].mean() < 0.05
    assert abs(np.median(distance[still])) < 0.005


def test_every_point_of_a_changed_object_carries_its_label(result):
    for cloud, count in ((result.before, "n_before"), (result.after, "n_after")):
        for record in result.records:
            members = cloud.fields["instance"] == record.object_id
            assert members.sum() == getattr(record, count)
            assert set(cloud.fields["change"][members]) <= {int(record.change)}


def test_points_of_undisturbed_ground_are_unchanged(result):
    xyz, change = result.after.xyz, result.after.fields["change"]
    flat = (abs(xyz[:, 2] - ground_z(xyz[:, 0], xyz[:, 1])) < 0.1) & (xyz[:, 1] < -6) & (xyz[:, 0] < -28)
    assert flat.sum() > 100
    assert set(change[flat]) == {int(Change.UNCHANGED)}


def test_the_raster_is_north_up_and_holds_the_strip(result):
    ground = result.ground
    row = int((ground.north - -4.75) / ground.cell)
    column = int((0.0 - ground.west) / ground.cell)
    assert ground.dz[row - 1 : row + 2, column].max() > 0.15
    assert np.nanmedian(ground.dz) == pytest.approx(0.0, abs=0.05)


def test_confidences_are_probabilities_and_stages_were_timed(result):
    assert all(0.0 <= r.confidence <= 1.0 for r in result.records)
    assert {"registration", "semantics", "objects", "ground"} <= set(result.seconds)


def test_nothing_changed_means_nothing_claimed():
    result = detect_changes(survey(BEFORE, 3), survey(BEFORE, 4), ChangeConfig(), transform=IDENTITY)
    assert {r.change for r in result.records} == {Change.UNCHANGED}
    for cloud in (result.before, result.after):
        assert not np.isin(cloud.fields["change"], [0, 1, 2, 3]).any()


def test_what_the_other_epoch_could_not_see_is_unobserved():
    small = Scene(houses=[(-15, 12)], trees=[(10, -6)], cars=[], poles=[])
    more = Scene(houses=[(-15, 12), (15, 12)], trees=[(10, -6)], cars=[], poles=[])
    hidden = (np.array([8.0, 6.0, -4.0]), np.array([22.0, 18.0, 14.0]))
    result = detect_changes(survey(small, 5, hidden), survey(more, 6), ChangeConfig(), transform=IDENTITY)
    record = at(result, Semantic.BUILDING, 15, 12)
    assert record.change is Change.UNOBSERVED
    assert record.observed_fraction < 0.1
    assert record.evidence == "observed"
    members = result.after.fields["instance"] == record.object_id
    assert set(result.after.fields["change"][members]) == {int(Change.UNOBSERVED)}
    assert at(result, Semantic.VEGETATION, 10, -6).change is Change.UNCHANGED


def test_the_same_input_gives_the_same_table():
    small = Scene(houses=[(-15, 12)], trees=[(10, -6)], cars=[], poles=[])
    tables = [
        detect_changes(survey(small, 5), survey(small, 6), ChangeConfig(), transform=IDENTITY).records
        for _ in "ab"
    ]
    assert [repr(r) for r in tables[0]] == [repr(r) for r in tables[1]]


def test_houses_and_trees_that_were_seen_worse_in_one_epoch_have_not_shrunk():
    """Half of the street lies far from the later drive: two points in three are missing there."""
    whole, thin = survey(BEFORE, 11), survey(BEFORE, 12)
    rng = np.random.default_rng(3)
    kept = (thin.cloud.xyz[:, 0] < 0) | (rng.random(len(thin.cloud.xyz)) < 0.33)
    worse = SurveyMap(thin.cloud.select(kept), visibility=thin.visibility)
    result = detect_changes(whole, worse, ChangeConfig(), transform=IDENTITY)
    houses = [r for r in result.records if r.semantic is Semantic.BUILDING]
    assert len(houses) == 4
    assert {r.change for r in houses} == {Change.UNCHANGED}
    assert not [r for r in result.records if r.change in (Change.INCREASED, Change.DECREASED)]


@pytest.mark.parametrize(("dense", "evidence"), [(True, "estimated"), (False, "shadow")])
def test_a_bare_cloud_is_judged_from_its_densest_ground_if_that_stands_out(dense, evidence):
    """Along the street between the houses a sensor leaves far more points on the ground than beside it."""
    rng = np.random.default_rng(21)
    fewer = Scene(houses=[BEFORE.houses[0], BEFORE.houses[3]], trees=BEFORE.trees, cars=[], poles=[])
    surveys = []
    for seed, scene in ((30, BEFORE), (31, fewer)):
        x, y = rng.uniform(-30, 30, 400_000), rng.uniform(-20, 9, 400_000)
        met = (rng.random(len(x)) < 1.0 / (1.0 + (y / 5.0) ** 2)) & dense
        road = np.column_stack([x, y, ground_z(x, y)])[met]
        cloud = scene.cloud(seed)
        surveys.append(SurveyMap(PointCloud(np.concatenate([cloud.xyz, road]), cloud.origin)))
    result = detect_changes(*surveys, ChangeConfig(), transform=IDENTITY)
    assert {r.evidence for r in result.records} == {evidence}
    labels = [at(result, Semantic.BUILDING, *house).change for house in BEFORE.houses]
    assert labels == [Change.UNCHANGED, Change.REMOVED, Change.REMOVED, Change.UNCHANGED]

"""Gone, or not seen? A box on a street, a wall, and a car that passed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.visibility_evidence import EvidenceConfig, ground_observed, make_observer
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.errors import InputError
from subiaco_geo.frames import make_pose
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.voxel_traversal import VisibilityAccumulator

ORIGIN = np.array([391_000.0, 6_464_000.0, 10.0])
# where a box stood in the other epoch: on the open street, and in the yard behind the wall
OPEN = np.array([[10.0, 5.0, 0.7], [10.5, 5.0, 0.8], [9.6, 5.3, 1.2]]) + ORIGIN
HIDDEN = np.array([[10.0, 12.0, 0.7], [11.0, 13.0, 0.3], [9.0, 12.5, 1.2]]) + ORIGIN
CONFIG = EvidenceConfig()


def counted(starts, ends):
    """Count beams (N, 3) -> (N, 3) [m, world] in voxels of 0.5 m."""
    accumulator = VisibilityAccumulator(ORIGIN - 50.0, 0.5)
    accumulator.add(starts, ends)
    return accumulator.grid()


def seen_points():
    """Street (y < 8) and the near face of a 4 m wall at y = 8; nothing behind it."""
    rng = np.random.default_rng(1)
    street = np.column_stack(
        [rng.uniform(-10, 30, 12_000), rng.uniform(-6, 8, 12_000), rng.normal(0, 0.01, 12_000)]
    )
    wall = np.column_stack([rng.uniform(-10, 30, 4000), np.full(4000, 8.0), rng.uniform(0, 4, 4000)])
    return voxel_downsample(PointCloud(np.vstack([street, wall]), ORIGIN, "EPSG:7850"), 0.25)


def drive():
    x = np.arange(-8.0, 28.0, 1.0)
    positions = np.column_stack([x, np.zeros_like(x), np.full_like(x, 2.0)]) + ORIGIN
    poses = make_pose(np.tile(np.eye(3), (len(x), 1, 1)), positions)
    return Trajectory(np.arange(len(x), dtype=np.int64) * 10**8, poses)


def test_a_removed_box_that_beams_passed_is_observed_gone_and_one_behind_a_wall_is_not():
    cloud = seen_points()
    world = cloud.world()
    sensor = drive().positions[np.abs(world[:, None, 0] - drive().positions[None, :, 0]).argmin(axis=1)]
    grid = counted(sensor, world)
    observer = make_observer(SurveyMap(cloud, visibility=grid), CONFIG)
    assert observer.kind == "observed"
    assert observer.observed(OPEN).all()
    assert observer.empty(OPEN).all()
    assert not observer.observed(HIDDEN).any()
    assert not observer.empty(HIDDEN).any()


def test_a_trajectory_gives_the_same_verdicts_without_a_visibility_layer():
    observer = make_observer(SurveyMap(seen_points(), trajectory=drive()), CONFIG)
    assert observer.kind == "trajectory"
    assert observer.observed(OPEN).all()
    assert observer.empty(OPEN).all()
    assert not observer.observed(HIDDEN).any()


def test_points_alone_give_a_conservative_verdict():
    observer = make_observer(SurveyMap(seen_points()), CONFIG)
    assert observer.kind == "shadow"
    assert observer.observed(OPEN).all()
    assert not observer.observed(HIDDEN).any()


def test_points_of_the_wall_are_observed_but_not_empty():
    cloud = seen_points()
    on_wall = np.array([[10.0, 8.0, 2.0], [3.0, 8.0, 1.0]]) + ORIGIN
    for survey in (SurveyMap(cloud, trajectory=drive()), SurveyMap(cloud)):
        observer = make_observer(survey, CONFIG)
        assert observer.observed(on_wall).all()
        assert not observer.empty(on_wall).any()


def test_the_papers_rule_is_taken_only_on_request_and_says_so():
    observer = make_observer(SurveyMap(seen_points()), EvidenceConfig(source="assumed"))
    assert observer.kind == "assumed"
    assert observer.observed(HIDDEN).all()


def test_evidence_that_the_map_lacks_is_refused():
    for source in ("observed", "trajectory"):
        with pytest.raises(InputError, match=source):
            make_observer(SurveyMap(seen_points()), EvidenceConfig(source=source))


def test_a_visibility_layer_in_another_frame_is_asked_there():
    cloud = seen_points()
    shift = np.array([1.5, -0.5, 0.0])
    grid = counted(np.tile(OPEN[:1] + np.array([0, -4, 1]), (3, 1)), OPEN)
    observer = make_observer(SurveyMap(cloud, visibility=grid), CONFIG, to_own=lambda world: world - shift)
    assert observer.observed(OPEN + shift).all()
    assert observer.observed(np.zeros((0, 3))).shape == (0,)


def test_ground_between_beams_is_seen_and_the_shadow_of_a_house_is_not():
    """Beams met two voxels in three of the street; behind x = 20 m a house hides everything."""
    met = np.random.default_rng(4).random((84, 84)) < 0.65

    def observed(xyz):
        cell = np.floor((xyz[:, :2] + [0.0, 21.0]) / 0.5).astype(int)
        inside = (cell >= 0).all(axis=1) & (cell < 84).all(axis=1) & (xyz[:, 0] < 20.0)
        clipped = np.clip(cell, 0, 83)
        return inside & met[clipped[:, 0], clipped[:, 1]] & (abs(xyz[:, 2]) < 0.25)

    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(2, 40, 4000), rng.uniform(-18, 18, 4000), np.zeros(4000)])
    seen = ground_observed(observed, ground, EvidenceConfig())
    street = ground[:, 0] < 18.9
    assert observed(ground)[street].mean() < 0.68
    assert seen[street].mean() == pytest.approx(0.80, abs=0.03)  # 0.65 + 0.35 P(Bin(8, 0.65) >= 6)
    assert not seen[ground[:, 0] > 20.0].any()


def test_ground_under_a_grazing_beam_is_seen():
    def observed(xyz):
        return xyz[:, 2] > 0.3

    ground = np.zeros((3, 3))
    assert ground_observed(observed, ground, EvidenceConfig()).all()
    assert not ground_observed(observed, ground, EvidenceConfig(ground_lift=0.2)).any()


def behind_the_crown(high: float) -> np.ndarray:
    """Return places (N, 3) 1.8 m behind the front of the crown, at a height [m]."""
    return np.column_stack([np.linspace(8, 12, 9), np.full(9, 9.8), np.full(9, high)]) + ORIGIN


def crown_over_seen_ground(front_m: float = 8.0) -> PointCloud:
    """Ground in full view, and the side towards the road of a crown 4 m above it, 8 m from the road."""
    rng = np.random.default_rng(8)
    ground = np.column_stack([rng.uniform(0, 20, 30000), rng.uniform(-2, 14, 30000), np.zeros(30000)])
    front = np.column_stack([rng.uniform(6, 14, 6000), np.full(6000, front_m), rng.uniform(3, 6, 6000)])
    return PointCloud(np.concatenate([ground, front]), ORIGIN)


def test_behind_foliage_a_trajectory_falls_back_on_the_points_with_less_trust():
    survey = SurveyMap(crown_over_seen_ground(), trajectory=drive())
    hidden = behind_the_crown(4.5)
    chance = make_observer(survey, CONFIG).free_probability(hidden)
    assert chance == pytest.approx(CONFIG.hidden_trust)
    assert chance.max() < MeasureConfig().free  # too little for an object of one epoch alone
    bare = make_observer(SurveyMap(survey.cloud), CONFIG).free_probability(hidden)
    assert (chance < bare).all()
    silent = CONFIG.model_copy(update={"hidden_trust": 0.5})
    assert make_observer(survey, silent).free_probability(hidden) == pytest.approx(0.5)


def test_behind_foliage_that_beams_went_through_a_trajectory_is_as_sure_as_the_points():
    """Leaves beyond the front of a crown that a depth image shows closed: beams did reach them."""
    rng = np.random.default_rng(9)
    seen = crown_over_seen_ground()
    inner = np.column_stack([rng.uniform(6, 14, 400), rng.uniform(9.2, 10.4, 400), np.full(400, 4.0)])
    survey = SurveyMap(PointCloud(np.concatenate([seen.xyz, inner]), ORIGIN), trajectory=drive())
    above = behind_the_crown(4.5)
    bare = make_observer(SurveyMap(survey.cloud), CONFIG)
    observer = make_observer(survey, CONFIG)
    assert bare.free_probability(above) == pytest.approx(CONFIG.shadow_trust)
    assert observer.free_probability(above) == pytest.approx(CONFIG.shadow_trust)
    assert observer.certainty(above) == pytest.approx(CONFIG.shadow_certain)
    assert (observer.free_probability(inner[:9] + ORIGIN) < 0.5).all()
    # The field of view may end in a crown: its points do not show that nothing stood above them.
    assert observer.free_above(above) == pytest.approx(CONFIG.hidden_trust)
    assert bare.free_above(above) == pytest.approx(CONFIG.shadow_trust)
    # The sensor is known to have looked higher: as many beams were due above those leaves as at them.
    view = {"elevation_min_deg": -25.0, "elevation_max_deg": 30.0, "useful_range_m": 40.0}
    looked_up = make_observer(replace(survey, info={"sensor": view}), CONFIG)
    assert looked_up.free_above(above) == pytest.approx(CONFIG.shadow_trust)
    sky = np.array([[10.0, 4.0, 5.0]]) + ORIGIN
    assert observer.free_above(sky) == pytest.approx(observer.free_probability(sky))


def test_at_the_front_of_foliage_a_trajectory_falls_back_on_the_points_and_is_as_certain_as_they():
    """Within 0.4 m behind the front of the crown a depth image tells nothing: it may be off by as much."""
    survey = SurveyMap(crown_over_seen_ground(8.2), trajectory=drive())
    observer = make_observer(survey, CONFIG)
    front = np.column_stack([np.linspace(8, 12, 9), np.full(9, 8.57), np.full(9, 4.5)]) + ORIGIN
    assert observer.free_probability(front) == pytest.approx(CONFIG.hidden_trust)
    assert observer.certainty(front) == pytest.approx(CONFIG.shadow_certain)
    on_it = front - np.array([0.0, 0.37, 0.0])
    assert (observer.free_probability(on_it) < 0.5).all()


def test_a_floor_seen_through_a_window_above_the_sensor_says_nothing_of_the_space_over_it():
    """Beams reach the ceiling of a room behind the front from below; they reach a shop floor from above."""
    rng = np.random.default_rng(10)
    street = crown_over_seen_ground()
    high = np.column_stack([rng.uniform(7, 13, 800), rng.uniform(9.2, 10.4, 800), np.full(800, 4.0)])
    cloud = PointCloud(np.concatenate([street.xyz[street.xyz[:, 1] <= 8.0], high]), ORIGIN)
    over = np.column_stack([np.linspace(8, 12, 9), np.full(9, 9.8), np.full(9, 5.2)]) + ORIGIN
    driven, bare = (make_observer(SurveyMap(cloud, trajectory=way), CONFIG) for way in (drive(), None))
    assert bare.empty(over).any()
    assert not driven.empty(over).any()
    assert driven.free_probability(over) == pytest.approx(0.5)
    low = PointCloud(np.concatenate([cloud.xyz, high * [1.0, 1.0, 0.0]]), ORIGIN)
    assert make_observer(SurveyMap(low, trajectory=drive()), CONFIG).empty(over).any()


def test_above_a_crown_that_hides_them_places_are_below_the_view_as_far_as_the_points_show():
    """Poses have the places behind the front of the crown in view, but do not tell how high beams reached."""
    observer = make_observer(SurveyMap(crown_over_seen_ground(), trajectory=drive()), CONFIG)
    bare = make_observer(SurveyMap(crown_over_seen_ground()), CONFIG)
    behind = np.array([[10.0, 13.0, 3.7], [10.0, 13.0, 4.6]]) + ORIGIN
    assert observer.certainty(behind).tolist() == [CONFIG.shadow_certain] * 2
    assert bare.below_view(behind).tolist() == [True, False]
    assert observer.below_view(behind).tolist() == [True, False]


def test_what_poses_see_free_rests_on_no_points_and_keeps_its_certainty():
    survey = SurveyMap(crown_over_seen_ground(), trajectory=drive())
    observer = make_observer(survey, CONFIG)
    beside_road = np.column_stack([np.linspace(8, 12, 9), np.full(9, 5.0), np.full(9, 3.5)]) + ORIGIN
    assert (observer.free_probability(beside_road) > CONFIG.hidden_trust).all()
    assert (observer.certainty(beside_road) == 1.0).all()
    bare = make_observer(SurveyMap(survey.cloud), CONFIG)
    assert (bare.certainty(beside_road) == CONFIG.shadow_certain).all()


def test_a_bare_cloud_knows_nothing_above_what_its_points_show_the_view_to_have_reached():
    """The crown ends at 6 m: whether the sensor saw any higher, its points do not tell."""
    observer = make_observer(SurveyMap(crown_over_seen_ground()), CONFIG)
    heights = np.array([1.0, 4.0, 5.2, 5.9, 6.2])
    at_crown = np.column_stack([np.full(5, 10.0), np.full(5, 8.0), heights]) + ORIGIN
    assert observer.below_view(at_crown).tolist() == [True, True, True, True, False]
    beside = at_crown - [0.0, 4.0, 0.0]  # nearer to the road the view of the same beam is 1.6 m lower
    assert observer.below_view(beside).tolist() == [True, True, False, False, False]
    far = at_crown - [0.0, 7.0, 0.0]
    assert not observer.below_view(far)[1]
    assert observer.free_probability(beside) == pytest.approx(0.8)  # an object of one epoch shows below too
    driven = make_observer(SurveyMap(crown_over_seen_ground(), trajectory=drive()), CONFIG)
    assert driven.below_view(beside).all()


@pytest.mark.parametrize(("seen_to", "free"), [(14.0, True), (8.4, False), (7.0, False)])
def test_a_place_at_the_rim_of_what_a_bare_cloud_holds_is_not_known_to_be_free(seen_to, free):
    """The ground in front of a wall is seen with the wall there or not; ground on both sides is not."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(0, 20, 30000), rng.uniform(-2, seen_to, 30000), np.zeros(30000)])
    observer = make_observer(SurveyMap(PointCloud(ground, ORIGIN)), CONFIG)
    wall = np.column_stack([np.linspace(5, 15, 21), np.full(21, 8.1), np.full(21, 1.5)]) + ORIGIN
    assert observer.free_probability(wall) == pytest.approx(CONFIG.shadow_trust if free else 0.5)


def test_a_bush_before_a_wall_that_was_seen_behind_it_is_known_to_be_gone():
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(0, 20, 30000), rng.uniform(-2, 8, 30000), np.zeros(30000)])
    wall = np.column_stack([rng.uniform(0, 20, 9000), np.full(9000, 8.0), rng.uniform(0, 4, 9000)])
    observer = make_observer(SurveyMap(PointCloud(np.concatenate([ground, wall]), ORIGIN)), CONFIG)
    bush = np.column_stack([np.linspace(8, 9, 5), np.full(5, 7.0), np.linspace(0.5, 1.5, 5)]) + ORIGIN
    assert observer.free_probability(bush) == pytest.approx(CONFIG.shadow_trust)


def test_half_a_storey_above_an_old_roof_is_free_space_in_a_bare_cloud_and_the_side_of_a_wall_is_not():
    """A house 3 m high on flat ground: the roof fills little above it, the wall all of its height."""
    rng = np.random.default_rng(6)
    ground = np.column_stack([rng.uniform(-10, 20, 40000), rng.uniform(-10, 20, 40000), np.zeros(40000)])
    ground = ground[~((np.abs(ground[:, 0] - 5) < 4) & (np.abs(ground[:, 1] - 5) < 4))]
    roof = np.column_stack([rng.uniform(1, 9, 6000), rng.uniform(1, 9, 6000), np.full(6000, 3.0)])
    wall = np.column_stack([rng.uniform(1, 9, 4000), np.full(4000, 1.0), rng.uniform(0, 3, 4000)])
    observer = make_observer(SurveyMap(PointCloud(np.concatenate([ground, roof, wall]), ORIGIN)), CONFIG)
    above = np.array([[5.0, 5.0, 3.2], [5.0, 5.0, 3.6], [5.0, 1.0, 3.7], [5.0, 5.0, 5.0]]) + ORIGIN
    assert observer.empty(above).tolist() == [False, True, True, True]
    beside = np.array([[5.0, 0.5, 1.5], [5.0, 0.5, 2.7], [5.0, 5.0, 2.0]]) + ORIGIN
    assert not observer.empty(beside).any()

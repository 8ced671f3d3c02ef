"""What two epochs must share before they are compared."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_change.registration.pair import check_pair
from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import transformer
from subiaco_geo.errors import InputError
from subiaco_geo.frames import make_pose
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory

PERTH = np.array([391_200.0, 6_464_300.0, 12.0])


def survey(crs="EPSG:7850", shift=(0.0, 0.0, 0.0), origin=PERTH, seed=1):
    xyz = np.random.default_rng(seed).uniform(0, 50, (5000, 3)) * (1, 1, 0.1)
    return SurveyMap(PointCloud(xyz + shift, origin, crs))


def test_both_clouds_come_back_about_one_origin_at_the_leaf_with_their_world_coordinates_kept():
    after = survey(origin=PERTH + np.array([100.0, -200.0, 0.0]), shift=(-100.0, 200.0, 0.0), seed=2)
    before, after, info = check_pair(survey(), after, leaf=1.0)
    assert np.array_equal(before.cloud.origin, after.cloud.origin)
    assert np.abs(before.cloud.world() - PERTH).max() < 51
    assert len(before.cloud) < 5000
    assert info.crs == "EPSG:7850"
    assert info.operation == "none"


def test_disjoint_extents_with_a_crs_are_refused_and_both_extents_named():
    with pytest.raises(InputError, match=r"391200 to 391250.*392200 to 392250"):
        check_pair(survey(), survey(shift=(1000.0, 0.0, 0.0)))


def test_disjoint_extents_without_a_crs_are_left_to_the_registration():
    before, after, info = check_pair(survey(crs=None), survey(crs=None, shift=(1000.0, 0.0, 0.0)))
    assert info.crs is None
    assert after.cloud.xyz[:, 0].min() > 900
    assert np.array_equal(before.cloud.origin, after.cloud.origin)


def test_gda94_is_brought_to_gda2020_and_the_accuracy_recorded():
    before = survey(crs="EPSG:28350")
    times = np.arange(3, dtype=np.int64)
    poses = make_pose(np.tile(np.eye(3), (3, 1, 1)), before.cloud.world()[:3])
    before = SurveyMap(before.cloud, trajectory=Trajectory(times, poses))
    moved, _, info = check_pair(before, survey(seed=2), leaf=0.01)
    shift = np.median(moved.cloud.world(), axis=0) - np.median(before.cloud.world(), axis=0)
    assert 1.0 < np.linalg.norm(shift[:2]) < 2.5  # Australia moved about 1.8 m
    assert moved.cloud.crs == "EPSG:7850"
    assert info.accuracy_m > 0
    assert np.allclose(moved.trajectory.positions - poses[:, :3, 3], shift, atol=0.05)
    back = transformer(info.crs, info.beams_crs).apply(moved.trajectory.positions)
    assert np.abs(back - poses[:, :3, 3]).max() < 1e-3


def test_a_ballpark_operation_is_refused():
    with pytest.raises(InputError, match="ballpark"):
        check_pair(survey(crs="EPSG:20250"), survey())


def test_one_crs_without_the_other_is_said():
    _, _, info = check_pair(survey(), survey(crs=None, origin=np.zeros(3)))
    assert "The survey AFTER states no CRS" in info.findings[0].text


def test_heights_above_the_geoid_against_heights_above_the_ellipsoid_are_refused_with_both_named():
    for shift, lower in ((33.1, "before"), (-33.1, "after")):
        with pytest.raises(InputError, match=rf"heights of {lower} are 33\.1 m lower.*geoid \(AHD"):
            check_pair(survey(), survey(shift=(0.3, 0.4, shift), seed=2))
        check_pair(survey(), survey(shift=(0.3, 0.4, shift), seed=2), aligned=False)


def test_a_hill_of_other_ground_is_no_other_kind_of_height():
    rng = np.random.default_rng(4)
    flat = rng.uniform(0, 50, (20_000, 3)) * (1, 1, 0.01)
    raised = flat + np.column_stack([np.zeros((len(flat), 2)), np.where(flat[:, 0] > 30, 8.0, 0.0)])
    before, after = (SurveyMap(PointCloud(xyz, PERTH, "EPSG:7850")) for xyz in (flat, raised))
    check_pair(before, after)


def test_a_wrong_zone_label_is_refused_and_the_right_zone_named():
    with pytest.raises(InputError, match="coordinates agree as they are") as refused:
        check_pair(survey(crs="EPSG:7851"), survey())
    assert "km apart" in str(refused.value)
    elsewhere = transformer("EPSG:7850", "EPSG:7851").apply(PERTH[None])[0]
    with pytest.raises(
        InputError, match="coordinates of before fit if its CRS is EPSG:7851 instead of EPSG:7850"
    ):
        check_pair(survey(origin=elsewhere), survey())


def test_a_frame_that_is_known_to_metres_only_is_a_warning():
    _, _, info = check_pair(survey(crs="EPSG:32750"), survey(seed=2))
    (found,) = info.findings
    assert (found.code, found.severity) == ("crs_operation", "warning")
    assert "accurate to 3.0 m" in found.sentence


def test_empty_clouds_and_nan_are_refused():
    with pytest.raises(InputError, match="before: the cloud is empty"):
        check_pair(SurveyMap(PointCloud(np.zeros((0, 3)))), survey())
    bad = survey()
    bad.cloud.xyz[:7, 2] = np.nan
    with pytest.raises(InputError, match="after: 7 points"):
        check_pair(survey(), bad)

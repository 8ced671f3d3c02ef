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
    assert "after has no CRS" in info.warnings[0]


def test_empty_clouds_and_nan_are_refused():
    with pytest.raises(InputError, match="before: the cloud is empty"):
        check_pair(SurveyMap(PointCloud(np.zeros((0, 3)))), survey())
    bad = survey()
    bad.cloud.xyz[:7, 2] = np.nan
    with pytest.raises(InputError, match="after: 7 points"):
        check_pair(survey(), bad)

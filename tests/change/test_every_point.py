"""The labelled clouds hold every point of the input, with the label of the voxel that it went into."""

import numpy as np
import pytest
from scenes import Scene
from scipy.spatial import cKDTree

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_in_tiles
from subiaco_geo.clouds import PointCloud, concatenate
from subiaco_geo.codes import Change
from subiaco_geo.frames import make_pose, transform_points
from subiaco_geo.sources import LoadedEpoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.work.task_runner import TaskRunner

SEED = 11
SHIFT = make_pose(np.eye(3), [0.4, -0.3, 0.1])
BEFORE = Scene(houses=[(-12, 13), (12, 13)], trees=[(-8, -13)])
AFTER = Scene(houses=[(-12, 13)], trees=[(-8, -13), (8, -13)])


def dense(scene, seed):
    """A survey with four points in the place of one, and an intensity that tells them apart."""
    cloud = scene.survey(seed).cloud
    rng = np.random.default_rng(SEED + seed)
    xyz = np.repeat(cloud.xyz, 4, axis=0) + rng.uniform(-0.1, 0.1, (4 * len(cloud), 3))
    fields = {"intensity": np.arange(len(xyz), dtype=np.float32)}
    return PointCloud(xyz, cloud.origin, cloud.crs, fields)


@pytest.fixture(scope="module")
def pair():
    before, after = dense(BEFORE, 1), dense(AFTER, 2)
    away = transform_points(np.linalg.inv(SHIFT), before.world()) - before.origin
    return PointCloud(away, before.origin, before.crs, before.fields), after


def compared(pair, **settings):
    config = ChangeConfig.model_validate({"tiles": {"size": 40}, **settings})
    epochs = tuple(LoadedEpoch(SurveyMap(cloud)) for cloud in pair)
    return detect_in_tiles(epochs, config, TaskRunner(), transform=SHIFT)


def whole(result, epoch):
    return concatenate(list(result.epoch(epoch)))


def test_every_point_of_the_input_is_written_at_its_own_place(pair):
    result = compared(pair)
    for name, cloud, pose in (("before", pair[0], SHIFT), ("after", pair[1], np.eye(4))):
        written = whole(result, name)
        order = np.argsort(written.fields["intensity"])
        assert np.array_equal(written.fields["intensity"][order], cloud.fields["intensity"])
        expected = transform_points(pose, cloud.world())
        np.testing.assert_allclose(written.world()[order], expected, atol=0.03)  # heights are matched too


def test_points_have_the_labels_of_the_thinned_points_that_they_went_into(pair):
    result = compared(pair)
    assert {Change.REMOVED, Change.UNCHANGED} <= set(whole(result, "before").fields["change"].tolist())
    for name in ("before", "after"):
        thinned = concatenate([result.tile(name, tile) for tile in result.tiles])
        written = whole(result, name)
        assert len(written) > 1.5 * len(thinned)
        near = cKDTree(thinned.xyz).query_ball_point(written.xyz, 0.25 * np.sqrt(3) + 1e-6)
        for field in ("change", "instance"):
            known, own = thinned.fields[field], written.fields[field]
            assert all(own[k] in known[found] for k, found in enumerate(near))


def test_the_thinned_points_are_written_where_the_user_asks_for_it(pair):
    result = compared(pair, every_point=False)
    for name in ("before", "after"):
        thinned = concatenate([result.tile(name, tile) for tile in result.tiles])
        assert np.array_equal(whole(result, name).xyz, thinned.xyz)

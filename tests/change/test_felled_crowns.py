"""Crowns felled out of a group, or planted into one, in sparse clouds measured from above."""

from __future__ import annotations

import numpy as np
import pytest
from park_scene import ground_z, survey
from scipy.spatial import cKDTree

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.survey_map import SurveyMap

RADIUS, APART = 3.4, 5.5  # of crowns and of their middles, so that crowns touch [m]
ROWS = (-24.0, -8.0, 8.0, 24.0)
CLAIMS = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)


def groups():
    """Rows of trees whose crowns touch."""
    rng = np.random.default_rng(3)
    return [[(x, y, rng.uniform(8.0, 12.0), RADIUS) for x in -11.0 + APART * np.arange(5)] for y in ROWS]


def standing():
    """All trees."""
    return [tree for row in groups() for tree in row]


def felled():
    """The third tree of every row."""
    return [row[2] for row in groups()]


def left():
    """The trees that stay."""
    return [tree for row in groups() for k, tree in enumerate(row) if k != 2]


def compare(before, after):
    return detect_changes(before, after, ChangeConfig(), transform=np.eye(4))


def in_crowns(cloud, trees):
    """Which points higher than 1.5 m lie nearer to the middle of one of some trees than its edge."""
    xyz = cloud.world()
    near = cKDTree([tree[:2] for tree in trees]).query(xyz[:, :2])[0] < 0.5 * APART
    return near & (xyz[:, 2] > ground_z(*xyz[:, :2].T) + 1.5)


def shares(cloud, trees, change):
    """Share of the points of every tree with a label."""
    return [float(np.mean(cloud.fields["change"][in_crowns(cloud, [tree])] == change)) for tree in trees]


@pytest.fixture(scope="module", params=[0.6, 1.2])
def surveys(request):
    return survey(standing(), request.param, 1), survey(left(), request.param, 2)


def test_a_crown_felled_out_of_a_group_is_removed_and_its_neighbours_stay(surveys):
    result = compare(*surveys)
    assert min(shares(result.before, felled(), Change.REMOVED)) > 0.6
    assert np.mean(shares(result.before, left(), Change.REMOVED)) < 0.08
    assert max(shares(result.before, left(), Change.REMOVED)) < 0.4


def test_a_crown_planted_into_a_group_is_added_and_its_neighbours_stay(surveys):
    result = compare(*surveys[::-1])
    assert min(shares(result.after, felled(), Change.ADDED)) > 0.6
    assert np.mean(shares(result.after, left(), Change.ADDED)) < 0.08
    assert max(shares(result.after, left(), Change.ADDED)) < 0.4


@pytest.mark.parametrize("spacing", [0.6, 1.2])
def test_nothing_is_claimed_of_groups_that_stay(spacing):
    result = compare(survey(standing(), spacing, 1), survey(standing(), spacing, 2))
    assert not [r.reason for r in result.records if r.change in CLAIMS]


def test_nothing_is_claimed_of_crowns_beneath_which_no_ground_was_seen(surveys):
    before, after = surveys
    xyz = after.cloud.xyz
    gone = cKDTree([tree[:2] for tree in felled()]).query(xyz[:, :2])[0] < RADIUS
    result = compare(before, SurveyMap(PointCloud(xyz[~gone])))
    assert max(shares(result.before, felled(), Change.REMOVED)) < 0.1


def off_row(xyz):
    """Distance (N,) north of the nearest row of trees [m]."""
    off = xyz[:, 1:2] - np.array(ROWS)
    return np.take_along_axis(off, np.abs(off).argmin(axis=1)[:, None], axis=1)[:, 0]


def test_crowns_of_which_a_side_was_cut_are_not_removed():
    whole, bare = survey(standing(), 0.6, 2).cloud.xyz, survey([], 0.6, 2).cloud.xyz
    edge = RADIUS / 3.0
    after = np.concatenate([whole[off_row(whole) <= edge], bare[off_row(bare) > edge]])
    result = compare(survey(standing(), 0.6, 1), SurveyMap(PointCloud(after)))
    assert max(shares(result.before, standing(), Change.REMOVED)) < 0.15

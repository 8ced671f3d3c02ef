"""Clouds whose points carry the probability of having moved, without the beams that mapping counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import Scene

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_change.tiling.epoch_preparation import with_times
from subiaco_geo.codes import Change

PLACE = (18.0, 3.0)


def test_the_larger_probability_of_shape_and_times_counts_and_nan_says_nothing():
    shape, times = np.array([0.0, 0.9, 0.3, 0.2]), np.array([0.5, 0.1, np.nan, 0.2])
    assert with_times(shape, times) == pytest.approx([0.5, 0.9, 0.3, 0.2])
    assert with_times(shape, None) is shape


def labels_of_a_shrub(moving):
    """Labels claimed at a shrub that *after* alone has, whose points carry this probability."""
    before, after = Scene().survey(1), Scene(trees=[*Scene().trees, (*PLACE, 1.9, 0.9)]).survey(2)
    near = np.linalg.norm(after.cloud.xyz[:, :2] - PLACE, axis=1) < 2.0
    field = np.where(near, moving, 0.0).astype(np.float32)
    cloud = replace(after.cloud, fields={**after.cloud.fields, "moving": field})
    result = detect_changes(before, replace(after, cloud=cloud), ChangeConfig(), transform=np.eye(4))
    claimed = [r for r in result.records if r.change in (Change.ADDED, Change.REMOVED)]
    return [r.change for r in claimed if np.hypot(r.x - PLACE[0], r.y - PLACE[1]) < 2.0]


@pytest.mark.parametrize(("moving", "claimed"), [(0.0, [Change.ADDED]), (0.5, [])])
def test_what_mapping_thinks_may_have_moved_is_no_claim_in_a_cloud_without_beams_either(moving, claimed):
    assert labels_of_a_shrub(moving) == claimed

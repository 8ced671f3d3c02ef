"""A real building site seen twice, and a part of it against itself: what was drawn by eye, and no claim.

Seen (``tests/benchmarks/bench_real_site.py``): the bounds leave room.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from bench_real_site import CLAIMS, read_site, read_truth, score

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_geo.clouds import PointCloud
from subiaco_geo.survey_map import SurveyMap

pytestmark = pytest.mark.slow


def test_the_changes_of_a_building_site_that_a_person_sees_are_found(shared_data: Path) -> None:
    result = detect_changes(read_site(shared_data, 0), read_site(shared_data, 1), ChangeConfig())
    found, wrong = score(result, read_truth())
    right = {item.name for item, _, share in found if share >= 0.5}
    assert {"site fence, north-east", "racks below the roof, east", "planted row, south-east"} <= right
    assert {"round wall", "lawn on the slope"} <= right
    assert len(right) >= 0.6 * len(found)
    assert len(wrong) <= 1


def test_a_site_against_its_own_other_half_of_points_claims_nothing(shared_data: Path) -> None:
    """Two draws of the points of one epoch: as a static pair of two scans."""
    cloud = read_site(shared_data, 1).cloud
    pick = np.random.default_rng(4).random(len(cloud)) < 0.5
    halves = [SurveyMap(PointCloud(cloud.xyz[m], cloud.origin)) for m in (pick, ~pick)]
    result = detect_changes(*halves, ChangeConfig(), transform=np.eye(4))
    assert [r.reason for r in result.records if r.change in CLAIMS] == []

"""The measured spacing of clouds: what it is for known clouds, and how settings follow it."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_change.outputs.rasters import LodRaster, lod_statement
from subiaco_change.point_spacing import (
    STREET_SPACING,
    PointSpacing,
    joint_spacing,
    measure_spacing,
    neighbour_spacings,
    spacing_scale,
)
from subiaco_report.cloud_windows import LodCounts
from subiaco_report.facts import lod_facts


@pytest.mark.parametrize("spacing", [0.1, 0.5, 2.0])
def test_the_spacing_of_points_drawn_on_a_sloping_plane_is_the_root_of_the_area_a_point_has(spacing):
    rng = np.random.default_rng(1)
    xy = rng.random((8000, 2)) * spacing * np.sqrt(8000)
    plane = np.column_stack([xy[:, 0], 0.8 * xy[:, 1], 0.6 * xy[:, 1]])
    assert measure_spacing(plane) == pytest.approx(spacing, rel=0.1)


def test_scan_lines_count_with_the_gaps_between_them():
    x, y = np.meshgrid(np.arange(0, 60, 0.25), np.arange(0, 60, 1.0))
    lines = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    assert measure_spacing(lines) == pytest.approx(0.5, rel=0.15)


def test_a_handful_of_points_has_no_spacing_and_changes_no_setting():
    few = np.random.default_rng(2).random((10, 3))
    assert len(neighbour_spacings(few)) == 0
    assert measure_spacing(few) == np.inf
    assert joint_spacing([]) == np.inf
    assert spacing_scale(np.inf) == 1.0
    assert spacing_scale(np.inf, 2 * STREET_SPACING) == pytest.approx(2.0)


def test_settings_grow_with_the_sparser_epoch_and_never_shrink():
    assert PointSpacing(0.1, 0.2).scale == 1.0
    assert PointSpacing(0.1, 3 * STREET_SPACING).scale == pytest.approx(3.0)
    assert PointSpacing(3 * STREET_SPACING, 0.1).coarser == pytest.approx(3 * STREET_SPACING)


def test_the_stated_level_of_detection_is_that_of_the_whole_map_and_not_of_where_it_exists():
    counts = LodCounts()
    counts.add(np.concatenate([np.full(10, 0.04), np.full(990, np.inf)]).astype(np.float32))
    assert lod_facts(counts) == {"median_cm": None, "p95_cm": None, "no_claim_percent": pytest.approx(99.0)}
    half = LodCounts()
    half.add(np.concatenate([np.full(600, 0.04), np.full(400, np.inf)]).astype(np.float32))
    assert half.percentile(50.0) == pytest.approx(0.04, abs=1e-4)
    assert half.percentile(95.0) is None


def test_cells_count_as_without_a_level_where_fewer_than_half_of_their_points_have_one():
    levels = np.array([[0.05, 0.05, 0.04], [0.08, np.nan, np.nan]], dtype=np.float32)
    claimed = np.array([[1.0, 0.9, 0.1], [0.8, 0.0, np.nan]], dtype=np.float32)
    found = lod_statement(LodRaster(levels, claimed, 0.0, 0.0, 5.0))
    assert found["share_without"] == pytest.approx(2 / 5)
    assert found["median_m"] == pytest.approx(0.08)
    assert found["median_where_known_m"] == pytest.approx(0.05)
    empty = lod_statement(LodRaster(levels, np.full((2, 3), 0.2, np.float32), 0.0, 0.0, 5.0))
    assert empty == {"median_m": None, "median_where_known_m": None, "share_without": 1.0}

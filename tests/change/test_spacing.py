"""The measured spacing of clouds: what it is for known clouds, and how settings follow it."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_change.spacing import (
    STREET_SPACING,
    PointSpacing,
    joint_spacing,
    measure_spacing,
    neighbour_spacings,
    spacing_scale,
)


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

"""Rows of houses part at steps of their roofs; single buildings stay whole."""

import numpy as np
import pytest
from scenes import house

from subiaco_change.semantics.boxes import box_sides
from subiaco_change.semantics.terraces import TerraceConfig, split_row


def row(*heights, width=6.0, angle=0.4):
    """Flat-roofed houses wall to wall, the row turned by an angle [rad]."""
    rng = np.random.default_rng(1)
    parts = [house(rng, (k + 0.5) * width, 0.0, width, 9.0, h) for k, h in enumerate(heights)]
    owner = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    xyz = np.concatenate(parts)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    inner = abs((xyz[:, 0] + width / 2) % width - width / 2) > 0.6  # party walls belong to either
    return xyz[:, :2] @ turn.T, xyz[:, 2], np.where(inner, owner, -1)


@pytest.mark.parametrize("heights", [(3.0, 6.0, 3.0), (6.0, 3.2), (3.0, 5.0, 7.0, 5.0)])
def test_every_house_of_a_stepped_row_is_one_part(heights):
    xy, height, owner = row(*heights)
    parts = split_row(xy, height, TerraceConfig())
    assert len(np.unique(parts)) == len(heights)
    for part in np.unique(parts):
        owners = owner[(parts == part) & (owner >= 0)]
        assert np.bincount(owners).max() > 0.98 * len(owners)


@pytest.mark.parametrize("heights", [(5.0,), (5.0, 5.0, 5.0), (5.0, 5.6)])
def test_no_step_no_cut(heights):
    xy, height, _ = row(*heights, width=8.0)
    assert split_row(xy, height, TerraceConfig()).max() == 0


def test_a_lean_to_narrower_than_a_house_stays_with_it():
    rng = np.random.default_rng(2)
    xyz = np.concatenate([house(rng, 0, 0, 10, 8, 6.0), house(rng, 6.2, 0, 2.4, 8, 2.6)])
    assert split_row(xyz[:, :2], xyz[:, 2], TerraceConfig()).max() == 0


def test_sides_of_a_turned_rectangle():
    xy = np.random.default_rng(3).uniform([-4, -1], [4, 1], (4000, 2))
    turned = xy @ np.array([[0.8, -0.6], [0.6, 0.8]])
    assert box_sides(turned) == pytest.approx((8.0, 2.0), abs=0.15)

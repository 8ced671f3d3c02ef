"""Level, smooth and wide surfaces some decimetres above the ground are ground that was raised."""

import numpy as np
import pytest

from subiaco_change.segmentation.features import EigenFeatureConfig, compute_features
from subiaco_change.segmentation.raised_ground import raised_ground

SEED = 20


def sheet(length, width, level, noise=0.015, spacing=0.25):
    """Points of a level surface with its step to the ground, which lies at z = 0 around it."""
    rng = np.random.default_rng(SEED)
    x, y = np.meshgrid(np.arange(-8, 8, spacing), np.arange(-8, 8, spacing))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.normal(0, 0.05, (x.size, 2))
    inside = (np.abs(xy[:, 0]) < 0.5 * length) & (np.abs(xy[:, 1]) < 0.5 * width)
    z = np.where(inside, level + rng.normal(0, noise, len(xy)), rng.normal(0, 0.015, len(xy)))
    return np.column_stack([xy, z]), inside


def found(xyz):
    return raised_ground(xyz, xyz[:, 2], compute_features(xyz, EigenFeatureConfig()))


@pytest.mark.parametrize("spacing", [0.15, 0.25, 0.35])
@pytest.mark.parametrize("level", [0.3, 0.5, 0.65])
def test_a_platform_is_raised_ground_at_any_density(level, spacing):
    xyz, inside = sheet(8.0, 4.0, level, spacing=spacing)
    inner = inside & (np.abs(xyz[:, 0]) < 3.5) & (np.abs(xyz[:, 1]) < 1.5)
    assert found(xyz)[inner].mean() > 0.95
    assert not found(xyz)[~inside].any()


@pytest.mark.parametrize(
    ("length", "width", "level", "noise"),
    [(8.0, 4.0, 0.5, 0.15), (8.0, 0.6, 0.5, 0.015), (1.2, 1.8, 0.65, 0.015), (8.0, 4.0, 1.0, 0.015)],
    ids=["a bed of plants", "a low wall", "a bonnet", "a table for a market"],
)
def test_what_is_rough_or_narrow_or_small_or_high_is_none(length, width, level, noise):
    assert not found(sheet(length, width, level, noise)[0]).any()


def test_the_fronts_of_a_trail_are_none():
    rng = np.random.default_rng(SEED)
    across, up = np.meshgrid(np.arange(-1.0, 1.1, 0.2), np.arange(0.2, 1.6, 0.2))
    fronts = [
        np.column_stack([np.full(up.size, x), across.ravel(), up.ravel()]) for x in np.arange(-8, 8, 1.5)
    ]
    xyz = np.concatenate([*fronts, sheet(0.0, 0.0, 0.0)[0]])
    assert not found(xyz + rng.normal(0, 0.01, xyz.shape)).any()

"""Isolated points are removed; a surface stays, however few beams reach it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.outliers import beam_spacing, isolated_points

CONFIG = FusionConfig()
STEP = np.radians(0.7)  # between two beams
HEIGHT = 2.0


def beams(rise_deg: float, turn: float = 2 * np.pi) -> np.ndarray:
    """Directions of a scanner whose columns and rows are STEP and ``rise_deg`` apart."""
    azimuth = np.arange(0, turn, STEP)
    elevation = np.radians(np.arange(-4, 4) * rise_deg)
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    return np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def ring(reach: float) -> np.ndarray:
    """Where one beam's row meets a level road, as far away as that."""
    azimuth = np.arange(0, 2, STEP)
    return np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), np.full(len(azimuth), -HEIGHT)])


def isolated(xyz: np.ndarray, spacing: float = STEP) -> np.ndarray:
    return isolated_points(xyz, np.linalg.norm(xyz, axis=1), spacing, CONFIG)


@pytest.mark.parametrize("rise_deg", [0.7, 1.1, 5.0])
def test_the_spacing_is_that_of_the_neighbours_asked_for(rise_deg: float) -> None:
    xyz = beams(rise_deg) * np.random.default_rng(1).uniform(2, 60, (len(beams(rise_deg)), 1))
    third = min(np.radians(rise_deg), 2 * STEP)  # two lie beside it in the row, the third above or farther on
    assert beam_spacing(xyz, 3) == pytest.approx(third, rel=0.03)


def test_a_handful_of_returns_tells_no_spacing() -> None:
    assert beam_spacing(beams(0.7)[:900], 3) == 0.0
    assert beam_spacing(np.zeros((0, 3)), 3) == 0.0


@given(st.floats(3.0, 69.0))
def test_a_lone_ring_on_the_road_stays_at_any_range(reach: float) -> None:
    assert not isolated(ring(reach)).any()


@pytest.mark.parametrize("reach", [3.0, 20.0, 69.0])
def test_drops_and_echoes_go_at_any_range(reach: float) -> None:
    aside = 1.1 * max(3 * STEP * reach, 2 * CONFIG.leaf)
    drops = np.array([[reach, 0.0, k * aside] for k in range(1, 5)])
    found = isolated(np.vstack([ring(reach), drops]))
    np.testing.assert_array_equal(found, np.arange(len(found)) >= len(ring(reach)))


def test_three_points_together_have_too_few_others_and_four_have_enough() -> None:
    pole = np.array([[10.0, 0.0, 0.25 * k] for k in range(4)]) * [1, 1, 0.6]
    assert isolated(pole[:3], 0.0).all()
    assert not isolated(pole, 0.0).any()


def test_without_neighbours_asked_for_all_stay() -> None:
    drops = np.array([[5.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    config = CONFIG.model_copy(update={"outlier_neighbours": 0})
    assert not isolated_points(drops, drops[:, 0], STEP, config).any()
    assert isolated_points(drops, drops[:, 0], STEP, CONFIG).all()


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.5, 30.0), count=st.integers(1, 300))
def test_the_cells_around_tell_what_the_distances_to_all_others_tell(seed, size, count) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-size, size, (count, 3)) * (1.0, 1.0, 0.2)
    reach = np.linalg.norm(xyz, axis=1)
    near = np.clip(CONFIG.outlier_spacings * STEP * reach, 2 * CONFIG.leaf, CONFIG.tile_overlap)
    others = np.linalg.norm(xyz[:, None] - xyz, axis=2) <= near[:, None]
    few = others.sum(axis=1) - 1 < CONFIG.outlier_neighbours
    assert np.array_equal(isolated(xyz), few)

from __future__ import annotations

import numpy as np
import pytest

from subiaco_mapping.robust_plane import fit_plane

PLACES = np.array([[x, y] for x in (-0.6, -0.2, 0.2, 0.6) for y in (-0.5, 0.0, 0.5)])


def on_plane(a: float, b: float, c: float) -> np.ndarray:
    return np.column_stack([PLACES, PLACES @ [a, b] + c])


def test_points_far_above_the_plane_do_not_move_it() -> None:
    points = on_plane(0.1, -0.2, 1.5)
    post = [[0.1, 0.1, 3.0], [0.1, 0.1, 4.0]]
    assert fit_plane(np.concatenate([points, post]), 8, 3.0, 1e-3) == pytest.approx([0.1, -0.2, 1.5])


def test_too_few_points_carry_no_plane() -> None:
    assert fit_plane(on_plane(0.0, 0.0, 0.0)[:7], 8, 3.0, 1e-3) is None
    assert fit_plane(np.zeros((0, 3)), 8, 3.0, 1e-3) is None


def test_points_on_a_line_carry_no_plane() -> None:
    along = np.linspace(-0.5, 0.5, 12)
    assert fit_plane(np.column_stack([along, along, along]), 8, 3.0, 1e-3) is None

"""Smallest rectangles around points seen from above."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from subiaco_change.segmentation.bounding_rectangles import box_coordinates, in_box_of


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 60),
    sizes=st.tuples(st.floats(0.0, 20.0), st.floats(0.0, 20.0)),
    turn=st.floats(0.0, np.pi),
    margin=st.floats(0.0, 2.0),
)
def test_points_lie_in_their_own_box_and_a_place_beyond_its_longest_diagonal_does_not(
    seed, count, sizes, turn, margin
):
    c, s = np.cos(turn), np.sin(turn)
    xy = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * sizes @ np.array([[c, s], [-s, c]])
    assert in_box_of(xy, xy, margin + 1e-9).all()
    reach = float(np.hypot(*np.ptp(box_coordinates(xy), axis=0))) + np.sqrt(2.0) * margin + 0.01
    towards = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    assert not in_box_of(xy, xy.mean(axis=0) + reach * towards, margin).any()


def test_the_box_of_points_on_a_line_has_no_width():
    line = np.column_stack([np.arange(5.0), np.zeros(5)])
    assert in_box_of(line, np.array([[2.0, 0.2], [4.2, 0.0], [2.0, 0.4], [4.4, 0.0]]), 0.3).tolist() == [
        True, True, False, False,
    ]  # fmt: skip

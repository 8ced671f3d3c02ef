"""Cells and keys of points are numbered in order, wherever they lie."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from subiaco_geo.clouds import extent_of, stable_order, unique_cells, unique_keys, within_box

near = arrays(np.int64, st.tuples(st.integers(1, 30), st.integers(1, 3)), elements=st.integers(-4, 4))
far = arrays(
    np.int64, st.tuples(st.integers(1, 30), st.integers(1, 3)), elements=st.integers(-(2**40), 2**40)
)


@given(st.one_of(near, far))
def test_cells_are_distinct_in_order_and_give_back_the_rows(cells):
    found, place = unique_cells(cells)
    np.testing.assert_array_equal(found, np.unique(cells, axis=0))
    np.testing.assert_array_equal(found[place], cells)


def test_no_rows_have_no_cells():
    found, place = unique_cells(np.zeros((0, 2), dtype=np.int64))
    assert (len(found), len(place)) == (0, 0)


@given(arrays(np.int64, st.integers(0, 60), elements=st.integers(-5, 5)))
def test_equal_keys_keep_their_order_and_distinct_ones_are_sorted(keys):
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(unique_keys(keys), np.unique(keys))


@given(
    arrays(
        np.int64,
        st.integers(0, 60),
        elements=st.one_of(
            st.integers(-(2**62), 2**62),
            st.integers(2**40, 2**40 + 5000),
            st.sampled_from([-(2**63), 2**63 - 1]),
        ),
    )
)
def test_keys_far_apart_and_close_together_are_sorted_by_their_digits(keys):
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@given(arrays(np.float64, st.integers(0, 60), elements=st.floats(-3, 3, width=16)))
def test_numbers_with_fractions_keep_the_order_of_equal_ones(keys):
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@given(near)
def test_extent_and_box_are_those_of_whole_rows(cells):
    low, high = extent_of(cells)
    np.testing.assert_array_equal([low, high], [cells.min(axis=0), cells.max(axis=0)])
    assert within_box(cells, low, high).all()
    inside = ((cells >= low + 1) & (cells <= high)).all(axis=1)
    np.testing.assert_array_equal(within_box(cells, low + 1, high), inside)

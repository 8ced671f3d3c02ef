"""Cells of points are numbered in order, wherever they lie."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from subiaco_geo.clouds import unique_cells

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

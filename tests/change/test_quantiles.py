"""Quantiles of few values."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from subiaco_change.quantiles import quantile_of

VALUES = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60)


@given(VALUES, st.floats(0.0, 1.0))
def test_a_quantile_is_bit_for_bit_that_of_numpy(values: list[float], share: float) -> None:
    of = np.array(values)
    before = of.copy()
    assert quantile_of(of, share) == np.quantile(of, share)
    assert np.array_equal(of, before)

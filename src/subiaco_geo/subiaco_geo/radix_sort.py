"""Radix sort of integer keys: the order of a stable sort in a few passes over the keys."""

from __future__ import annotations

import numba
import numpy as np

from subiaco_geo.frames import Ints

_DIGIT = 11  # bits that one pass sorts by: its counts stay in the first cache
_WIDEST = 62  # bits of the span of keys, so that differences of keys are int64


def radix_order(keys: Ints) -> Ints | None:
    """Return the order (N,) of int64 keys (N,), equal ones as they stand; None for too wide a span."""
    if len(keys) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = int(keys.min()), int(keys.max())
    bits = (high - low).bit_length()
    return _order(keys, low, bits, _DIGIT) if bits <= _WIDEST else None


@numba.njit(cache=True)
def _order(keys: Ints, low: int, bits: int, digit: int) -> Ints:
    """Sort by digits, the lowest first; a digit that all keys share is passed over."""
    count, values = len(keys), keys - low
    order, next_order, next_values = np.arange(count), np.empty(count, np.int64), np.empty(count, np.int64)
    mask = (1 << digit) - 1
    for shift in range(0, bits, digit):
        place = np.zeros(mask + 2, np.int64)
        for i in range(count):
            place[((values[i] >> shift) & mask) + 1] += 1
        if place.max() == count:
            continue
        for k in range(mask):
            place[k + 1] += place[k]
        for i in range(count):
            own = (values[i] >> shift) & mask
            next_values[place[own]], next_order[place[own]] = values[i], order[i]
            place[own] += 1
        values, next_values = next_values, values
        order, next_order = next_order, order
    return order

"""What the worker processes of a run load, once for all of them: every stage, and the compiler of numba.

A process that calls a function of numba for the first time sets the compiler up, which takes as long as many
tasks of a small map. Processes that are forked from one that did so have it.
"""

from __future__ import annotations

import gc

import numpy as np

gc.disable()  # loading makes a million objects and hardly any garbage
import subiaco_change.tiling.run  # noqa: E402, F401 - for the workers
from subiaco_geo.radix_sort import radix_order  # noqa: E402

radix_order(np.arange(1024))
gc.freeze()  # workers need not look through what all of them share
gc.enable()

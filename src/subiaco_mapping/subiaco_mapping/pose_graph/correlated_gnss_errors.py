"""Correlated GNSS errors as states of the pose graph.

Errors of neighbouring RTK fixes are alike (atmosphere, orbit, multipath that lingers, a wrong ambiguity):
a first-order Gauss-Markov process a receiver state. Were they taken for independent, a hundred fixes of
one red light would claim a millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.pose_graph.records import GnssPriors

KNOTS_PER_CORRELATION_TIME = NUMBERS.pose_graph.correlation_knots


@dataclass(frozen=True)
class SlowErrors:
    """Knots of the process.

    Parameters
    ----------
    knot : (N,) int64
        Knot of every fix.
    epoch : (K,) int64
        Of every knot: the state held without a break; errors of two epochs have nothing in common.
    step : (K,) float64
        Knot to the one before over the correlation time; 0 for the first of an epoch.
    sigma : (K, 3) float64
        Stationary [m].
    """

    knot: Ints
    epoch: Ints
    step: Floats
    sigma: Floats

    def __len__(self) -> int:
        return len(self.epoch)


def receiver_epochs(times_ns: Ints, status: Ints, gap_ns: int) -> Ints:
    """Give every fix (N,) the number of its stretch of one state without a gap."""
    new = (np.diff(status) != 0) | (np.diff(times_ns) > gap_ns)
    return np.concatenate([[0], np.cumsum(new)]).astype(np.int64)[: len(times_ns)]


def slow_errors(priors: GnssPriors, config: GnssConfig) -> SlowErrors | None:
    """Lay out the knots; None where errors are declared white."""
    if config.correlation_time == 0 or config.correlated_share == 0 or len(priors.index) == 0:
        return None
    span_ns = config.correlation_time * 1e9 / KNOTS_PER_CORRELATION_TIME
    epoch = receiver_epochs(priors.times_ns, priors.status, config.epoch_gap_ns)
    slot = np.floor((priors.times_ns - priors.times_ns[0]) / span_ns).astype(np.int64)
    cells, knot = np.unique(epoch * (slot.max() + 1) + slot, return_inverse=True)
    count = np.bincount(knot)
    variance = np.diagonal(priors.covariance, axis1=1, axis2=2)
    sums = np.stack([np.bincount(knot, variance[:, k]) for k in range(3)], axis=1)
    of_knot, at = cells // (slot.max() + 1), cells % (slot.max() + 1)
    step = np.concatenate([[0.0], np.diff(at) / KNOTS_PER_CORRELATION_TIME])
    step[np.concatenate([[True], np.diff(of_knot) != 0])] = 0.0
    sigma = np.sqrt(config.correlated_share * sums / count[:, None])
    return SlowErrors(knot.astype(np.int64), of_knot, step, sigma)


def own_precision(step: float, next_step: float) -> float:
    """Return the precision of a knot's own prior, over that of the stationary process.

    The density of a Gauss-Markov process is a product of differences of neighbours, each of precision
    :func:`link_precision`, and of one prior a knot: this one. A step of 0 means no neighbour.
    """
    return 1.0 - sum(_lean(s) for s in (step, next_step) if s > 0)


def _lean(step: float) -> float:
    keep = np.exp(-step)
    return float(keep / (1.0 + keep))


def link_precision(step: float) -> float:
    """Return the precision of the difference of two neighbouring knots, over the stationary one."""
    keep = np.exp(-step)
    return float(keep / (1.0 - keep**2))

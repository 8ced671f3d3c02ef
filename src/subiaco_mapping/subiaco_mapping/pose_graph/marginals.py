"""Marginal covariances of poses, also of weakly connected parts of the graph."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats
from subiaco_mapping.method_numbers import NUMBERS

_PRECISE = NUMBERS.pose_graph.marginal_residual


class SparseMarginals:
    """Marginals from the normal equations, each variable scaled.

    gtsam's Cholesky refuses pivots that are 4096 times smaller than their neighbours, as those of a
    segment are that nothing but the way since the last one places (20 m against a millimetre).

    Parameters
    ----------
    linear : gtsam.GaussianFactorGraph

    Raises
    ------
    RuntimeError
        The graph is singular.
    """

    def __init__(self, linear: Any) -> None:
        keys = linear.keyVector()
        zero = linear.gradientAtZero()
        sizes = [len(zero.at(key)) for key in keys]
        self._start = dict(zip(keys, np.cumsum([0, *sizes[:-1]]), strict=True))
        rows, columns, values = linear.sparseJacobian_()
        places = (rows.astype(int) - 1, columns.astype(int) - 1)
        jacobian = csc_array((values, places))[:, : sum(sizes)]
        normal = csc_array(jacobian.T @ jacobian)
        self._scale = 1.0 / np.sqrt(normal.diagonal())
        self._normal = csc_array(normal.multiply(self._scale[:, None]).multiply(self._scale))
        self._solve = splu(self._normal).solve
        self._solved(np.ones(sum(sizes)))

    def marginalCovariance(self, key: int) -> Floats:
        """Return the covariance (6, 6) of a pose, rotation first, its own axes."""
        place = self._start[key] + np.arange(6)
        right = np.zeros((len(self._scale), 6))
        right[place, np.arange(6)] = 1.0
        block = self._solved(right)[place] * self._scale[place, None] * self._scale[place]
        return np.asarray(0.5 * (block + block.T))

    def _solved(self, right: Floats) -> Floats:
        found = self._solve(right)
        if not np.abs(self._normal @ found - right).max() < _PRECISE:
            raise RuntimeError("the graph is singular")
        return np.asarray(found)


def marginals_of(graph: Any, values: Any) -> Any:
    """Return an object whose ``marginalCovariance(key)`` is a pose's.

    Raises
    ------
    SubiacoError
        A pose is not determined.
    """
    try:
        return gtsam.Marginals(graph, values)
    except RuntimeError as error:
        first = str(error).strip().splitlines()[0]
    try:
        return SparseMarginals(graph.linearize(values))
    except RuntimeError as error:
        raise SubiacoError(
            f"pose graph: a pose is not determined ({first}); check GNSS and extrinsics"
        ) from error

"""Paired bootstrap over tiles, which tells whether one method is better than another on the same places."""

from __future__ import annotations

from typing import Any

import numpy as np

from subiaco_evaluation.grid import GridConfig, cell_centres
from subiaco_evaluation.scores import Codes, confusion, scores
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints

TILE = 80.0  # edge of a tile, as the paper's [m]


def tile_matrices(keys: Ints, truth: Codes, said: Codes, grid: GridConfig, tile: float = TILE) -> Ints:
    """Return the 5x6 change matrices (T, 5, 6) of the tiles that cells (M,) lie in, by place."""
    corner = np.floor(cell_centres(keys, grid) / tile).astype(np.int64)
    _, slot = np.unique(corner, axis=0, return_inverse=True)
    slot = slot.ravel()
    count = int(slot.max(initial=-1)) + 1
    found = [confusion(truth[slot == t], said[slot == t]) for t in range(count)]
    return np.stack(found) if found else np.zeros((0, 5, 6), dtype=np.int64)


def paired_difference(first: Ints, second: Ints, draws: int, seed: int) -> dict[str, Any]:
    """Compare two methods on the same tiles.

    Parameters
    ----------
    first, second : (T, 5, 6) int
        Change matrices of the same T tiles, in one order.
    draws : int
        Bootstrap draws of T tiles with replacement; both methods get the same.
    seed : int

    Returns
    -------
    dict
        ``tiles``, and by score: ``difference_percent`` (first less second, all tiles pooled),
        ``interval_95_percent`` of it, and ``better_fraction`` of the draws.

    Raises
    ------
    InputError
        The tiles are not the same, or fewer than two.
    """
    if first.shape != second.shape or len(first) < 2:
        raise InputError(
            f"paired bootstrap: {len(first)} and {len(second)} tiles; give both methods the same survey,"
            " of two tiles or more"
        )
    rng = np.random.default_rng(seed)
    weights = rng.multinomial(len(first), np.full(len(first), 1 / len(first)), size=draws)
    sums = [(weights @ m.reshape(len(m), -1)).reshape(draws, 5, 6) for m in (first, second)]
    drawn = [(scores(a), scores(b)) for a, b in zip(*sums, strict=True)]
    whole = scores(first.sum(axis=0)), scores(second.sum(axis=0))
    result: dict[str, Any] = {"tiles": len(first)}
    for name in whole[0]:
        steps = np.array([a[name] - b[name] for a, b in drawn])
        result[name.removesuffix("_percent")] = {
            "difference_percent": whole[0][name] - whole[1][name],
            "interval_95_percent": [float(q) for q in np.nanpercentile(steps, [2.5, 97.5])],
            "better_fraction": float(np.mean(steps > 0)),
        }
    return result

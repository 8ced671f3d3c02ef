"""Paired bootstrap over tiles, which tells whether one method is better than another on the same places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from subiaco_evaluation.grid import GridConfig, cell_centres
from subiaco_evaluation.scores import Codes, confusion, scores
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

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


def block_differences(
    cells: Sequence[tuple[Ints, Ints]], objects: Sequence[Ints], draws: int, seed: int
) -> dict[str, tuple[float, float, float]]:
    """Compare two methods on the same surveys, of which surveys and then their blocks are drawn.

    Parameters
    ----------
    cells : sequence of (array, array)
        Of every survey the change matrices (B, 5, 6) of its blocks by the first and by the second method.
    objects : sequence of (K,) int
        Of every survey the differences of a count of objects in its blocks, first less second.
    draws : int
        Bootstrap draws; surveys are drawn with replacement, then the blocks of each.
    seed : int

    Returns
    -------
    dict
        ``miou`` [percent] and ``objects``: difference over everything, and both ends of its 95 % interval.
    """
    rng = np.random.default_rng(seed)
    often = rng.multinomial(len(cells), np.full(len(cells), 1 / len(cells)), size=draws)
    sums, counts = np.zeros((2, draws, 30)), np.zeros(draws)
    for survey, (pair, own) in enumerate(zip(cells, objects, strict=True)):
        blocks = len(pair[0])
        weights = rng.multinomial(often[:, survey] * blocks, np.full(blocks, 1 / blocks))
        sums += np.stack([weights @ m.reshape(blocks, 30) for m in pair])
        if len(own):
            counts += rng.multinomial(often[:, survey] * len(own), np.full(len(own), 1 / len(own))) @ own
    steps = _miou(sums[0]) - _miou(sums[1])
    whole = [_miou(np.sum([pair[k].sum(axis=0) for pair in cells], axis=0)[None])[0] for k in (0, 1)]
    return {
        "miou": (float(whole[0] - whole[1]), *_middle_95(steps)),
        "objects": (float(sum(own.sum() for own in objects)), *_middle_95(counts)),
    }


def _middle_95(values: Floats) -> tuple[float, float]:
    """Return both ends of the interval that holds the middle 95 % of values (N,)."""
    low, high = np.nanpercentile(values, [2.5, 97.5])
    return float(low), float(high)


def _miou(matrices: Floats) -> Floats:
    """Return the mIoU [percent] (N,) of change matrices (N, 5, 6), flat or not."""
    counts = matrices.reshape(-1, 5, 6)
    hits = np.diagonal(counts[:, :, :5], axis1=1, axis2=2)
    union = counts.sum(axis=2) + counts[:, :, :5].sum(axis=1) - hits
    iou = np.divide(hits, union, out=np.full(hits.shape, np.nan), where=union > 0)
    return np.asarray(100.0 * np.nanmean(iou, axis=1))

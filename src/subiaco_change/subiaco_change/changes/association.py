"""Which object of one epoch is which of the other (method, part D, Decisions 8 to 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching
from scipy.spatial import cKDTree

from subiaco_change.changes.measures import histogram_distance, oriented_rectangle, rectangle_iou
from subiaco_change.changes.objects import Thing
from subiaco_change.changes.parts import PartConfig
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

#: A scipy sparse array; scipy has no types.
Sparse = Any
#: Weights of centroid distance [1/m], 1 - IoU and histogram distance, paper.
_PAPER_COST = (1.0, 2.0, 0.5)
_PHI_REACH = 0.5  # voxels farther apart are not the intersection of two objects [m]


class AssociationConfig(StrictModel):
    """Gates, scales and prices of the assignment."""

    gate_distance: float = Field(2.0, gt=0, description="centroid distance of a candidate, paper [m]")
    gate_overlap: float = Field(
        0.3, gt=0, le=1, description="footprint IoU of a candidate at any distance (Decision 8)"
    )
    spread_distance: float = Field(
        1.0, gt=0, description="spread of the centroid of the same object [m] (Decision 11)"
    )
    spread_relative: float = Field(0.15, ge=0, description="and per metre of its size")
    spread_overlap: float = Field(0.35, gt=0, description="spread of 1 - footprint IoU of the same object")
    spread_histogram: float = Field(
        0.35, gt=0, description="spread of the histogram distance of the same object"
    )
    cost: Literal["scaled", "plain"] = Field(
        "scaled", description="plain adds metres and ratios with the paper's weights 1, 2, 0.5 (Decision 11)"
    )
    kappa: float = Field(
        0.0,
        ge=0,
        description="weight of phi = max(0, LoD95 - d_perp) in the plain cost, paper 2 (Decision 8) [1/m]",
    )
    unmatched: float = Field(6.0, gt=0, description="price of one unmatched object, on the chi-square scale")
    contained: float = Field(
        0.5, gt=0, le=1, description="share of its voxels that puts a fragment inside an object (Decision 9)"
    )
    parts: PartConfig = PartConfig()
    apart: float = Field(
        0.15,
        gt=0,
        le=1,
        description="share of a match from which on one of several fragments may be a body of its own",
    )
    stacked: float = Field(
        0.3, ge=0, le=1, description="share of common columns from which on two fragments are one body"
    )
    same_place: float = Field(0.5, gt=0, le=1, description="voxel overlap of one thing with two classes (C6)")


@dataclass(frozen=True)
class Match:
    """Objects of *before* and *after*, positions in their lists, that are one object."""

    before: tuple[int, ...]
    after: tuple[int, ...]

    @property
    def kind(self) -> str:
        """one_to_one, split, merge or none; many to many counts as the side with more parts."""
        if not self.before or not self.after:
            return "none"
        if len(self.before) == 1 and len(self.after) == 1:
            return "one_to_one"
        return "split" if len(self.after) >= len(self.before) else "merge"


def overlap_counts(
    before: Sequence[Thing], after: Sequence[Thing], tolerance: float
) -> tuple[Sparse, Sparse]:
    """Count voxels of every object whose nearest voxel of the other epoch is in each object there.

    Parameters
    ----------
    before, after : sequence of Thing
    tolerance : float
        Voxels farther apart do not overlap [m].

    Returns
    -------
    forward, backward : (B, A) and (A, B) sparse arrays
        Of voxels of *before* in *after*, and the other way round.
    """
    first, second = _stack(before), _stack(after)
    shape = (len(before), len(after))
    return (
        _nearest_counts(first, second, shape, tolerance),
        _nearest_counts(second, first, shape[::-1], tolerance),
    )


def _stack(things: Sequence[Thing]) -> tuple[Floats, Ints]:
    if not things:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    owner = np.repeat(np.arange(len(things)), [len(t.voxels) for t in things])
    return np.concatenate([t.voxels.xyz for t in things]), owner


def _nearest_counts(
    source: tuple[Floats, Ints], target: tuple[Floats, Ints], shape: tuple[int, int], tolerance: float
) -> Sparse:
    if len(source[0]) == 0 or len(target[0]) == 0:
        return coo_array(shape).tocsr()
    distance, slot = cKDTree(target[0]).query(source[0], distance_upper_bound=tolerance)
    hit = np.isfinite(distance)
    pairs = (source[1][hit], target[1][slot[hit]])
    return coo_array((np.ones(int(hit.sum())), pairs), shape=shape).tocsr()


def associate(
    before: Sequence[Thing], after: Sequence[Thing], config: AssociationConfig, tolerance: float
) -> list[Match]:
    """Match the objects of one class, each object in exactly one match.

    Fragments of one object are grouped, groups are assigned at the least
    cost, and left-over fragments join the match that contains them.
    """
    if not before or not after:
        return _unmatched(before, after)
    forward, backward = overlap_counts(before, after, tolerance)
    groups_b = _group_fragments(before, forward, config)
    groups_a = _group_fragments(after, backward, config)
    rows, columns, costs = candidate_costs(before, after, groups_b, groups_a, config)
    pairs = assign(len(groups_b), len(groups_a), rows, columns, costs, config.unmatched)
    matches = [Match(groups_b[i], groups_a[j]) for i, j in pairs]
    used_b = {i for match in matches for i in match.before}
    used_a = {j for match in matches for j in match.after}
    matches = _adopt(matches, before, after, (forward, backward), (used_b, used_a), config)
    rest_b = [i for i in range(len(before)) if i not in used_b]
    rest_a = [j for j in range(len(after)) if j not in used_a]
    found = [*matches, *_match_contained(rest_b, rest_a, before, after, (forward, backward), config)]
    return _uncrossed(found, before, after)


def _uncrossed(matches: Sequence[Match], before: Sequence[Thing], after: Sequence[Thing]) -> list[Match]:
    """Make one match of those between parts of the same two instances.

    Of a house that lost most of itself, what is left may be parted, and paired with what is gone.
    """
    wholes = [
        {(before[i].body, after[j].body) for i in match.before for j in match.after} for match in matches
    ]
    numbers = {pair: k for k, pair in enumerate(sorted(set().union(*wholes)))}
    links = [(m, len(matches) + numbers[pair]) for m, pairs in enumerate(wholes) for pair in pairs]
    nodes = len(matches) + len(numbers)
    rows, columns = zip(*links, strict=True) if links else ((), ())
    graph = coo_array((np.ones(len(links)), (np.array(rows, int), np.array(columns, int))), (nodes, nodes))
    group = connected_components(graph.tocsr(), directed=False)[1][: len(matches)]
    united: dict[int, list[Match]] = {}
    for match, number in zip(matches, group.tolist(), strict=True):
        united.setdefault(number, []).append(match)
    return [
        Match(tuple(i for m in same for i in m.before), tuple(j for m in same for j in m.after))
        for same in united.values()
    ]


def _match_contained(
    rest_b: Sequence[int],
    rest_a: Sequence[int],
    before: Sequence[Thing],
    after: Sequence[Thing],
    counts: tuple[Sparse, Sparse],
    config: AssociationConfig,
) -> list[Match]:
    """Match left-over objects of which one lies inside the other, however little their shapes agree.

    A tree cut apart leaves a small piece of a large crown: its centre, outline
    and heights are others, its place is not.
    """
    sides = ((before, rest_b, rest_a, counts[0]), (after, rest_a, rest_b, counts[1]))
    links = [_contained(things, own, other, count, config) for things, own, other, count in sides]
    graph = links[0] + links[1].T
    nodes = len(rest_b) + len(rest_a)
    rows, columns = graph.nonzero()
    square = coo_array((np.ones(len(rows)), (rows, columns + len(rest_b))), shape=(nodes, nodes))
    group = connected_components(square.tocsr(), directed=False)[1] if nodes else np.zeros(0, dtype=np.int64)
    found = []
    for number in range(int(group.max(initial=-1)) + 1):
        members = np.flatnonzero(group == number).tolist()
        found.append(
            Match(
                tuple(rest_b[k] for k in members if k < len(rest_b)),
                tuple(rest_a[k - len(rest_b)] for k in members if k >= len(rest_b)),
            )
        )
    return found


def _unmatched(before: Sequence[Thing], after: Sequence[Thing]) -> list[Match]:
    return [*(Match((i,), ()) for i in range(len(before))), *(Match((), (j,)) for j in range(len(after)))]


def _contained(
    things: Sequence[Thing],
    own: Sequence[int],
    other: Sequence[int],
    counts: Sparse,
    config: AssociationConfig,
) -> Sparse:
    """Mark which of a few things lie mostly inside which of a few of the other epoch."""
    inside = counts[list(own), :][:, list(other)].tocoo()
    sizes = np.array([len(things[i].voxels) for i in own], dtype=np.float64)
    mostly = inside.data > config.contained * sizes[inside.row]
    where = (inside.row[mostly], inside.col[mostly])
    return coo_array((np.ones(int(mostly.sum())), where), shape=inside.shape).tocsr()


def _group_fragments(
    things: Sequence[Thing], counts: Sparse, config: AssociationConfig
) -> list[tuple[int, ...]]:
    """Group the fragments that lie in the same object of the other epoch; the others stand alone."""
    sizes = np.maximum([len(t.voxels) for t in things], 1)
    groups: dict[int, list[int]] = {}
    dense = counts.tocoo()
    share = dense.data / sizes[dense.row]
    host = {
        int(r): int(c) for r, c, s in zip(dense.row, dense.col, share, strict=True) if s > config.contained
    }
    for i in range(len(things)):
        groups.setdefault(host.get(i, -1 - i), []).append(i)
    return [tuple(group) for group in groups.values()]


def _adopt(
    matches: list[Match],
    before: Sequence[Thing],
    after: Sequence[Thing],
    counts: tuple[Sparse, Sparse],
    used: tuple[set[int], set[int]],
    config: AssociationConfig,
) -> list[Match]:
    """Let unmatched fragments that lie inside a matched partner join it; ``used`` grows."""
    adopted = []
    for match in matches:
        more_b = _inside(before, counts[0], match.after, used[0], config)
        more_a = _inside(after, counts[1], match.before, used[1], config)
        used[0].update(more_b)
        used[1].update(more_a)
        adopted.append(Match((*match.before, *more_b), (*match.after, *more_a)))
    return adopted


def _inside(
    things: Sequence[Thing], counts: Sparse, hosts: tuple[int, ...], used: set[int], config: AssociationConfig
) -> list[int]:
    column = np.asarray(counts[:, list(hosts)].sum(axis=1)).ravel()
    found = np.flatnonzero(column).tolist()
    return [i for i in found if i not in used and column[i] > config.contained * len(things[i].voxels)]


def candidate_costs(
    before: Sequence[Thing],
    after: Sequence[Thing],
    groups_b: Sequence[tuple[int, ...]],
    groups_a: Sequence[tuple[int, ...]],
    config: AssociationConfig,
) -> tuple[Ints, Ints, Floats]:
    """Gated pairs of groups (E,), (E,) and their chi-square costs (E,)."""
    shapes_b = [_shape([before[i] for i in group]) for group in groups_b]
    shapes_a = [_shape([after[j] for j in group]) for group in groups_a]
    rows, columns, costs = [], [], []
    for i, j in _near_pairs(shapes_b, shapes_a, config):
        b, a = shapes_b[i], shapes_a[j]
        overlap = rectangle_iou(b.rectangle, a.rectangle)
        distance = float(np.linalg.norm(b.centroid - a.centroid))
        if distance > config.gate_distance and overlap < config.gate_overlap:
            continue
        rows.append(i)
        columns.append(j)
        costs.append(_cost(distance, overlap, b, a, config))
    return (
        np.array(rows, dtype=np.int64),
        np.array(columns, dtype=np.int64),
        np.array(costs, dtype=np.float64),
    )


def _cost(distance: float, overlap: float, b: _Shape, a: _Shape, config: AssociationConfig) -> float:
    """Price of calling two groups one object: a chi-square, or the paper's plain sum."""
    histogram = histogram_distance(b.heights, a.heights, 10)
    if config.cost == "plain":
        weights = _PAPER_COST
        printed = weights[0] * distance + weights[1] * (1 - overlap) + weights[2] * histogram
        return printed + (config.kappa * _phi(b, a) if config.kappa > 0 else 0.0)
    spread = config.spread_distance + config.spread_relative * max(b.size, a.size)
    terms = (distance / spread, (1 - overlap) / config.spread_overlap, histogram / config.spread_histogram)
    return sum(t**2 for t in terms)


def _phi(b: _Shape, a: _Shape) -> float:
    """Return how far the median separation along the normal stays under the level of detection [m]."""
    distance, slot = cKDTree(a.xyz).query(b.xyz, distance_upper_bound=_PHI_REACH)
    shared = np.isfinite(distance)
    level = max(b.lod, a.lod)
    if not shared.any() or not np.isfinite(level):
        return 0.0
    step = a.xyz[slot[shared]] - b.xyz[shared]
    return max(0.0, level - float(np.median(np.abs(np.einsum("ij,ij->i", b.normal[shared], step)))))


@dataclass(frozen=True)
class _Shape:
    xyz: Floats
    normal: Floats
    lod: float
    centroid: Floats
    heights: Floats
    rectangle: object
    size: float
    reach: float


def _shape(things: Sequence[Thing]) -> _Shape:
    xyz = np.concatenate([t.voxels.xyz for t in things])
    heights = np.concatenate([t.voxels.height for t in things])
    size = float(np.linalg.norm(np.ptp(xyz, axis=0)))
    normal = np.concatenate([t.voxels.normal for t in things])
    lod = max(t.lod for t in things)
    return _Shape(xyz, normal, lod, xyz.mean(axis=0), heights, oriented_rectangle(xyz[:, :2]), size, size / 2)


def _near_pairs(
    shapes_b: Sequence[_Shape], shapes_a: Sequence[_Shape], config: AssociationConfig
) -> list[tuple[int, int]]:
    """Pairs of groups whose circles come within the gate."""
    tree = cKDTree([s.centroid[:2] for s in shapes_a])
    widest = max(s.reach for s in shapes_a)
    pairs: list[tuple[int, int]] = []
    for i, shape in enumerate(shapes_b):
        reach = config.gate_distance + shape.reach + widest
        pairs.extend((i, j) for j in sorted(tree.query_ball_point(shape.centroid[:2], reach)))
    return pairs


def assign(
    count_b: int, count_a: int, rows: Ints, columns: Ints, costs: Floats, unmatched: float
) -> list[tuple[int, int]]:
    """Find the one-to-one assignment of least total cost, dummies included.

    Minimises the costs of the pairs taken plus ``unmatched`` for every object
    left over on either side, solved exactly per connected component of the
    candidate graph (Decision 10).
    """
    worth = costs < 2 * unmatched
    rows, columns, costs = rows[worth], columns[worth], costs[worth]
    if len(rows) == 0:
        return []
    nodes = count_b + count_a
    graph = coo_array((np.ones(len(rows)), (rows, columns + count_b)), shape=(nodes, nodes))
    component = connected_components(graph.tocsr(), directed=False)[1][rows]
    pairs: list[tuple[int, int]] = []
    for number in np.unique(component):
        inside = component == number
        pairs.extend(_assign_component(rows[inside], columns[inside], costs[inside], unmatched))
    return sorted(pairs)


def _assign_component(rows: Ints, columns: Ints, costs: Floats, unmatched: float) -> list[tuple[int, int]]:
    left, row = np.unique(rows, return_inverse=True)
    right, column = np.unique(columns, return_inverse=True)
    dummies = np.arange(len(left))
    weights: NDArray[np.float64] = np.concatenate([costs, np.full(len(left), 2 * unmatched)]) + 1.0
    where = (np.concatenate([row, dummies]), np.concatenate([column, dummies + len(right)]))
    graph = coo_array((weights, where), shape=(len(left), len(right) + len(left))).tocsr()
    chosen_row, chosen_column = min_weight_full_bipartite_matching(graph)
    real = chosen_column < len(right)
    return [(int(left[i]), int(right[j])) for i, j in zip(chosen_row[real], chosen_column[real], strict=True)]

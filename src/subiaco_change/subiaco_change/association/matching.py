"""Matching of the objects of two epochs (method, part D, Decisions 8 to 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from subiaco_change.association.config import AssociationConfig
from subiaco_change.association.costs import Sparse, candidate_costs, overlap_counts
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_change.segmentation.clustering import connect
from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class Match:
    """Objects of *before* and *after*, positions in their lists, that are one object."""

    before: tuple[int, ...]
    after: tuple[int, ...]

    @property
    def kind(self) -> str:
        """As :func:`match_kind` names it."""
        return match_kind(len(self.before), len(self.after))


def match_kind(parts_before: int, parts_after: int) -> str:
    """one_to_one, split, merge or none; many to many counts as the side with more parts."""
    if not parts_before or not parts_after:
        return "none"
    if parts_before == parts_after == 1:
        return "one_to_one"
    return "split" if parts_after >= parts_before else "merge"


def associate(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    config: AssociationConfig,
    tolerance: float,
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


def _uncrossed(
    matches: Sequence[Match], before: Sequence[ObjectInstance], after: Sequence[ObjectInstance]
) -> list[Match]:
    """Make one match of those between parts of the same two instances.

    The remaining part of a house that lost most of itself may be split, and matched with the removed part.
    """
    wholes = [
        {(before[i].body, after[j].body) for i in match.before for j in match.after} for match in matches
    ]
    numbers = {pair: k for k, pair in enumerate(sorted(set().union(*wholes)))}
    links = [(m, len(matches) + numbers[pair]) for m, pairs in enumerate(wholes) for pair in pairs]
    pairs = np.array(links, dtype=np.int64).reshape(-1, 2)
    group = connect(len(matches) + len(numbers), pairs)[: len(matches)]
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
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    counts: tuple[Sparse, Sparse],
    config: AssociationConfig,
) -> list[Match]:
    """Match left-over objects of which one lies inside the other, however little their shapes agree.

    A tree cut apart leaves a small piece of a large crown: its centre, outline
    and heights are others, its place is not.
    """
    sides = ((before, rest_b, rest_a, counts[0]), (after, rest_a, rest_b, counts[1]))
    links = [_contained(objects, own, other, count, config) for objects, own, other, count in sides]
    graph = links[0] + links[1].T
    rows, columns = graph.nonzero()
    group = connect(len(rest_b) + len(rest_a), np.column_stack([rows, columns + len(rest_b)]))
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


def _unmatched(before: Sequence[ObjectInstance], after: Sequence[ObjectInstance]) -> list[Match]:
    return [*(Match((i,), ()) for i in range(len(before))), *(Match((), (j,)) for j in range(len(after)))]


def _contained(
    objects: Sequence[ObjectInstance],
    own: Sequence[int],
    other: Sequence[int],
    counts: Sparse,
    config: AssociationConfig,
) -> Sparse:
    """Mark which of a few objects lie mostly inside which of a few of the other epoch.

    Places that the other epoch did not observe say nothing: of what is left of a house that was partly
    demolished most was hidden inside.
    """
    inside = counts[list(own), :][:, list(other)].tocoo()
    sizes = np.array([np.count_nonzero(objects[i].voxels.observed) for i in own], dtype=np.float64)
    mostly = inside.data > config.contained * sizes[inside.row]
    where = (inside.row[mostly], inside.col[mostly])
    return coo_array((np.ones(int(mostly.sum())), where), shape=inside.shape).tocsr()


def _group_fragments(
    objects: Sequence[ObjectInstance], counts: Sparse, config: AssociationConfig
) -> list[tuple[int, ...]]:
    """Group the fragments that lie in the same object of the other epoch; the others stand alone."""
    sizes = np.maximum([len(t.voxels) for t in objects], 1)
    groups: dict[int, list[int]] = {}
    dense = counts.tocoo()
    share = dense.data / sizes[dense.row]
    host = {
        int(r): int(c) for r, c, s in zip(dense.row, dense.col, share, strict=True) if s > config.contained
    }
    for i in range(len(objects)):
        groups.setdefault(host.get(i, -1 - i), []).append(i)
    return [tuple(group) for group in groups.values()]


def _adopt(
    matches: list[Match],
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
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
    objects: Sequence[ObjectInstance],
    counts: Sparse,
    hosts: tuple[int, ...],
    used: set[int],
    config: AssociationConfig,
) -> list[int]:
    column = np.asarray(counts[:, list(hosts)].sum(axis=1)).ravel()
    found = np.flatnonzero(column).tolist()
    return [i for i in found if i not in used and column[i] > config.contained * len(objects[i].voxels)]


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
    component = connect(count_b + count_a, np.column_stack([rows, columns + count_b]))[rows]
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

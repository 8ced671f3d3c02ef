"""Loop candidates from the estimate and from descriptors, verified by registration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import KDTree

from subiaco_geo.frames import Floats, invert_pose, make_pose
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.loop_closure.consistency import disagreement, reach_of
from subiaco_mapping.loop_closure.overlay import overlay
from subiaco_mapping.loop_closure.places import LoopCandidate, SubmapPlace
from subiaco_mapping.loop_closure.scan_context import Descriptor, compare, describe
from subiaco_mapping.loop_closure.submap_registration import PreparedSubmap, SubmapRegistration, register
from subiaco_mapping.pose_graph.gnss import level_rotation
from subiaco_mapping.pose_graph.records import LoopEdge

_KEPT = 32  # prepared submaps in memory


def level_axes(up_lidar: Floats, T_base_lidar: Floats) -> Floats:
    """Return the rotation (3, 3) from ``lidar_link`` to axes x ahead, z up, from *up* in ``lidar_link``."""
    base = T_base_lidar[:3, :3]
    return np.asarray(level_rotation(base @ up_lidar) @ base)


@dataclass
class LoopFinder:
    """Propose and verify; what was described or registered once is not again."""

    config: LoopConfig
    threads: int = 1
    counts: Counter[str] = field(default_factory=Counter)
    _described: dict[tuple[int, int], Descriptor] = field(default_factory=dict)
    _prepared: dict[tuple[int, int], PreparedSubmap] = field(default_factory=dict)
    _registered: dict[tuple[tuple[int, int], tuple[int, int]], SubmapRegistration] = field(
        default_factory=dict
    )

    def by_estimate(self, places: Sequence[SubmapPlace]) -> list[LoopCandidate]:
        """Propose, for every place, the nearest other visit by each chain."""
        posed = [place for place in places if place.pose is not None]
        if len(posed) < 2:
            return []
        positions = np.array([place.pose[:2, 3] for place in posed if place.pose is not None])
        tree = KDTree(positions)
        found: dict[tuple[tuple[int, int], tuple[int, int]], LoopCandidate] = {}
        for i, place in enumerate(posed):
            near = tree.query_ball_point(positions[i], self.config.near + min(reach_of(place), 20.0))
            near.sort(key=lambda j: float(np.linalg.norm(positions[i] - positions[j])))
            seen: set[int] = set()
            for j in near:
                other = posed[j]
                if other.key[0] in seen or not self._another_visit(place, other):
                    continue
                seen.add(other.key[0])
                first, second = sorted((place, other), key=lambda p: p.key)
                guess = invert_pose(_pose(first)) @ _pose(second)
                found[first.key, second.key] = LoopCandidate(first, second, guess)
        return list(found.values())

    def by_descriptor(self, places: Sequence[SubmapPlace]) -> list[LoopCandidate]:
        """Propose, for every place, the most alike of the others before it."""
        descriptors = [self._describe(place) for place in places]
        found = []
        for i, place in enumerate(places):
            distance, yaw = compare(descriptors[i], descriptors[:i])
            taken = 0
            for j in np.argsort(distance):
                if taken == self.config.descriptor_matches or distance[j] > self.config.max_distance:
                    break
                if self._another_visit(places[j], place):
                    taken += 1
                    found.append(LoopCandidate(places[j], place, None, -float(yaw[j])))
        return found

    def _another_visit(self, one: SubmapPlace, other: SubmapPlace) -> bool:
        apart = abs(one.submap.way - other.submap.way)
        return one.key[0] != other.key[0] or apart > self.config.min_way

    def verified(self, candidates: Sequence[LoopCandidate]) -> list[tuple[LoopCandidate, SubmapRegistration]]:
        """Register candidates; what geometry does not bear out is counted and left out."""
        found = []
        for candidate in sorted(candidates, key=lambda c: (c.first.key, c.second.key)):
            result = self._register(candidate)
            reason = result.refused(self.config)
            self.counts["refused_" + reason if reason else "verified"] += 1
            if reason is None:
                found.append((candidate, result))
        return found

    def close(self, places: Sequence[SubmapPlace]) -> list[LoopEdge]:
        """Return the loops that geometry and the present estimate bear out, all places being posed."""
        near = self.by_estimate(places)
        known = {(c.first.key, c.second.key) for c in near}
        alike = [c for c in self.by_descriptor(places) if (c.first.key, c.second.key) not in known]
        possible = [c for c in alike if self._possible(c)]
        self.counts = Counter(
            proposed_by_estimate=len(near),
            proposed_by_descriptor=len(alike),
            refused_graph=len(alike) - len(possible),
        )
        return self.borne_out([*near, *possible])

    def borne_out(self, candidates: Sequence[LoopCandidate]) -> list[LoopEdge]:
        """Return the loops of candidates that geometry and the present estimate bear out."""
        edges = []
        for candidate, result in self.verified(candidates):
            edge = edge_of(candidate, result)
            if disagreement(edge, candidate.first, candidate.second) > self.config.gate:
                self.counts["refused_graph"] += 1
            else:
                edges.append(edge)
        return edges

    def _possible(self, candidate: LoopCandidate) -> bool:
        apart = np.linalg.norm(_pose(candidate.first)[:3, 3] - _pose(candidate.second)[:3, 3])
        reach = np.hypot(reach_of(candidate.first), reach_of(candidate.second))
        return bool(apart < 2 * self.config.submap_length + reach)

    def _levelled(self, place: SubmapPlace) -> Floats:
        return np.asarray(place.submap.points() @ place.R_level_lidar.T)

    def _describe(self, place: SubmapPlace) -> Descriptor:
        if place.key not in self._described:
            self._described[place.key] = describe(self._levelled(place), self.config.radius)
        return self._described[place.key]

    def _prepare(self, place: SubmapPlace) -> PreparedSubmap:
        if place.key not in self._prepared:
            if len(self._prepared) >= _KEPT:
                self._prepared.pop(next(iter(self._prepared)))
            self._prepared[place.key] = PreparedSubmap(place.submap.points(), self.threads)
        return self._prepared[place.key]

    def _register(self, candidate: LoopCandidate) -> SubmapRegistration:
        first, second = candidate.first, candidate.second
        key = first.key, second.key
        if key not in self._registered:
            guess = candidate.guess
            if guess is None:
                laid = overlay(self._levelled(first), self._levelled(second), candidate.yaw)
                levels = [make_pose(p.R_level_lidar, np.zeros(3)) for p in (first, second)]
                guess = invert_pose(levels[0]) @ laid @ levels[1]
            self._registered[key] = register(self._prepare(first), self._prepare(second), guess, self.config)
        return self._registered[key]


def _pose(place: SubmapPlace) -> Floats:
    assert place.pose is not None
    return place.pose


def edge_of(candidate: LoopCandidate, result: SubmapRegistration) -> LoopEdge:
    """Return the loop of a registration."""
    first, second = candidate.first.scan, candidate.second.scan
    return LoopEdge(first, second, result.T_target_source, result.covariance)

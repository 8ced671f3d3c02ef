"""The pose graph of a survey: recordings placed and joined, loops closed, solved."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from subiaco_geo.crs import EnuFrame
from subiaco_geo.crs_area import crs_at, require_inside
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.absolute_positions.positioning import AbsoluteFacts, position
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.loop_closure.finder import LoopFinder, level_axes
from subiaco_mapping.loop_closure.places import SubmapPlace
from subiaco_mapping.loop_closure.sequence_joining import join
from subiaco_mapping.pose_graph.incremental import LiveGraph
from subiaco_mapping.pose_graph.records import Chain, LoopEdge, Solved
from subiaco_mapping.pose_graph.solver import solve
from subiaco_mapping.sequences import SequenceRecord
from subiaco_mapping.survey_graph.sequence_chains import Placement, chain_of, place_sequences, summary
from subiaco_mapping.survey_graph.solution import (
    GraphSolution,
    LiveEstimate,
    LiveSequence,
    LoopFacts,
    SolvedGraph,
)

logger = logging.getLogger(__name__)


@dataclass
class _State:
    """What is placed so far."""

    chains: dict[int, Chain]
    waiting: dict[int, Chain]
    joints: list[LoopEdge]


@dataclass
class _Live:
    """The graph while driving; it restarts where another frame is found."""

    frame: EnuFrame | None
    graph: LiveGraph
    places: dict[tuple[int, int], Floats] = field(default_factory=dict)  # covariance when first seen


class SurveyGraph:
    """Solve what sequences have brought; registrations are kept from one time to the next.

    Parameters
    ----------
    config : MappingConfig
    """

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._finder = LoopFinder(config.loops, config.threads)
        self._live: _Live | None = None

    def solve(self, sequences: list[SequenceRecord]) -> GraphSolution:
        """Place, join, close loops, solve.

        Raises
        ------
        InputError
            A sequence can be placed neither by GNSS nor by what it shares with the others, GNSS is
            required and does not place one, or the fixes are where the CRS must not be used.
        """
        placement = place_sequences(sequences, self._config)
        state = self._start(sequences, placement)
        while state.waiting:
            self._join(sequences, state, placement)
        solved = self._solved(state.chains, state.joints)
        edges: list[LoopEdge] = []
        if self._config.loops.enabled:
            edges = self._finder.close(self._solved_places(sequences, state.chains, solved))
            solved = self._solved(state.chains, edges) if edges else solved
        solved, absolute = self._positioned(sequences, state, placement, solved, edges or state.joints)
        order = range(len(sequences))
        found = tuple(summary(sequences[k], state.chains[k], solved.chains[k]) for k in order)
        reason = None if placement.frame is not None else placement.reasons[0]
        between = np.array([e.first[0] != e.second[0] for e in edges], dtype=np.bool_)
        facts = LoopFacts(dict(self._finder.counts), between, solved.loop_weights, solved.seams)
        graph = SolvedGraph(state.chains, tuple(edges or state.joints), solved)
        loops = facts if edges else LoopFacts(facts.counts)
        return GraphSolution(found, placement.frame, reason, loops, graph, absolute)

    def _positioned(
        self,
        sequences: list[SequenceRecord],
        state: _State,
        placement: Placement,
        solved: Solved,
        edges: list[LoopEdge],
    ) -> tuple[Solved, AbsoluteFacts | None]:
        """Solve again with control points and a reference; fixes then stand where these put them."""
        built = {number: sequences[number].submaps for number in state.chains}
        submaps = {
            (number, submap.anchor): submap
            for number, own in built.items()
            if own is not None
            for submap in own.done
        }
        frame, crs = placement.frame, None
        if frame is not None:
            crs = crs_at(frame.latitude_deg, frame.longitude_deg, self._config.crs)
        configs = self._config.graph, self._config.gnss
        solved, facts = position(
            self._config, (frame, crs), submaps, solved,
            lambda ties: solve(state.chains, *configs, edges, ties),
        )  # fmt: skip
        if np.any(solved.gnss_offset):
            state.chains.update(
                {number: chain.shifted(solved.gnss_offset) for number, chain in state.chains.items()}
            )
        return solved, facts

    def preview(self, sequences: list[SequenceRecord]) -> LiveEstimate:
        """Take what is new since the last time, by ISAM2; loops by the present estimate alone.

        Raises
        ------
        InputError
            GNSS is required and does not place a sequence, or the fixes are where the CRS must not be used.
        """
        placement = place_sequences(sequences, self._config)
        state = self._start(sequences, placement)
        if self._live is None or self._live.frame != placement.frame:
            self._live = _Live(placement.frame, LiveGraph(self._config.graph, self._config.gnss))
        live = self._live
        poses = live.graph.update(state.chains)
        edges = self._live_loops(sequences, state.chains, poses, live)
        if edges:
            poses = live.graph.update(state.chains, edges)
        found = []
        for number, chain in sorted(state.chains.items()):
            own = poses[number]
            odom = own[-1] @ invert_pose(chain.T_odom_lidar[-1])
            fixes = 0 if chain.gnss is None else len(chain.gnss.index)
            found.append(LiveSequence(sequences[number].name, chain.stamps_ns, own, odom, fixes))
        reason = None if placement.frame is not None else placement.reasons[0]
        return LiveEstimate(tuple(found), placement.frame, reason)

    def _live_loops(
        self,
        sequences: list[SequenceRecord],
        chains: dict[int, Chain],
        poses: dict[int, Floats],
        live: _Live,
    ) -> list[LoopEdge]:
        """Close loops of the submaps that are new."""
        new = set()
        for number in chains:
            submaps = sequences[number].submaps
            for k, submap in enumerate([] if submaps is None else submaps.done):
                if (number, k) not in live.places:
                    new.add((number, k))
                    live.places[number, k] = live.graph.covariance(number, submap.anchor)
        places = self._places(sequences, chains, poses, live.places)
        near = [c for c in self._finder.by_estimate(places) if c.first.key in new or c.second.key in new]
        return self._finder.borne_out(near)

    def _solved(self, chains: dict[int, Chain], edges: list[LoopEdge]) -> Solved:
        return solve(chains, self._config.graph, self._config.gnss, edges)

    def _start(self, sequences: list[SequenceRecord], placement: Placement) -> _State:
        """Take what GNSS places; of a local map, the first sequence."""
        if placement.frame is not None:
            latitude, longitude = placement.frame.latitude_deg, placement.frame.longitude_deg
            require_inside(latitude, longitude, crs_at(latitude, longitude, self._config.crs))
        placed = [reason is None for reason in placement.reasons]
        for sequence, reason in zip(sequences, placement.reasons, strict=True):
            if reason is not None and self._config.gnss.required:
                raise InputError(
                    f"{sequence.name}: cannot be georeferenced ({reason}); record GNSS over a longer way, "
                    "or set gnss.required: false"
                )
        if placement.frame is None:
            logger.warning("%s: %s; the map is local, without CRS", sequences[0].name, placement.reasons[0])
            placed[0] = True
        chains = {
            k: chain_of(sequence, placement.frame, self._config, placed=placed[k])
            for k, sequence in enumerate(sequences)
        }
        ready = {k: chain for k, chain in chains.items() if placed[k]}
        return _State(ready, {k: chain for k, chain in chains.items() if not placed[k]}, [])

    def _join(self, sequences: list[SequenceRecord], state: _State, placement: Placement) -> None:
        """Place one of the waiting chains by its loops."""
        waiting = {k: chain.T_odom_lidar for k, chain in state.waiting.items()}
        found = None
        if self._config.loops.enabled:
            solved = self._solved(state.chains, state.joints)
            places = self._solved_places(sequences, {**state.chains, **state.waiting}, solved)
            found = join(self._finder, places, waiting)
        if found is None:
            number = min(waiting)
            raise InputError(
                f"{sequences[number].name}: cannot be georeferenced ({placement.reasons[number]}), and too "
                "few places of it were found in the other sequences; record GNSS over a longer way, drive "
                "an overlap, or map it alone"
            )
        number, T_world_odom, edges = found
        logger.info("%s: joined by %d places seen twice", sequences[number].name, len(edges))
        state.chains[number] = replace(state.waiting.pop(number), T_world_odom=T_world_odom)
        state.joints.extend(edges)

    def _places(
        self,
        sequences: list[SequenceRecord],
        chains: dict[int, Chain],
        poses: Mapping[int, Floats],
        covariances: Mapping[tuple[int, int], Floats],
    ) -> list[SubmapPlace]:
        """Return the submaps where they are; those of chains without ``poses`` have none."""
        found = []
        for number in sorted(chains):
            sequence, chain = sequences[number], chains[number]
            submaps = [] if sequence.submaps is None else sequence.submaps.done
            for k, submap in enumerate(submaps):
                at = submap.anchor
                known = poses[number][at] if number in poses else None
                pose = chain.T_world_odom @ chain.T_odom_lidar[at] if known is None else known
                axes = level_axes(pose[2, :3], sequence.extrinsics.T_base_lidar)
                covariance = covariances.get((number, k), np.eye(6))
                found.append(SubmapPlace((number, k), submap, axes, known, covariance))
        return found

    def _solved_places(
        self, sequences: list[SequenceRecord], chains: dict[int, Chain], solved: Solved
    ) -> list[SubmapPlace]:
        poses = {number: solution.T_world_lidar for number, solution in solved.chains.items()}
        covariances = {}
        for number, solution in solved.chains.items():
            submaps = sequences[number].submaps
            for k, submap in enumerate([] if submaps is None else submaps.done):
                covariances[number, k] = solution.covariance[submap.anchor]
        return self._places(sequences, chains, poses, covariances)

"""The change run over the tiles of a city, stage by stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from subiaco_change.decisions.confidence import rows_of_pair
from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.tiling.alignment import (
    DisplacementSlice,
    LodSlice,
    PlacingSlice,
    find_bias,
    find_sigma,
    find_warp,
    tile_displacements,
    tile_heights,
    tile_lods,
    tile_residuals,
)
from subiaco_change.tiling.candidate_groups import (
    CandidateGroups,
    CandidateSlice,
    GroupParams,
    GroupSlice,
    find_groups,
    tile_links,
)
from subiaco_change.tiling.decision_stages import (
    ComparisonSlice,
    PlantDecisionSlice,
    PlantSlice,
    compare_tile,
    decide_tile,
    find_vegetation_null,
)
from subiaco_change.tiling.epoch_stages import SIGHT, Epochs, corners_around
from subiaco_change.tiling.epoch_tiles import EPOCHS, tiles_between
from subiaco_change.tiling.ground_stage import (
    GroundSlice,
    JoinedComponents,
    PatchParams,
    PatchSlice,
    join_over,
    patch_tiles,
    tile_ground,
    tile_over,
    tile_patches,
)
from subiaco_change.tiling.label_stage import ChangedParams, LabelSlice, label_tile, tile_changed
from subiaco_change.tiling.registration_stage import register_again
from subiaco_change.tiling.retiling import EpochObjects, EpochTileParams, place_tile
from subiaco_change.tiling.stage_inputs import PairRegistration, TileParams, slice_of
from subiaco_change.tiling.table_stage import Table, build_table
from subiaco_change.visibility_evidence import weakest
from subiaco_geo.tiles import neighbours
from subiaco_geo.work.tasks import WHOLE, Inputs, Task

#: Stages in their order; *compare* and what it rests on run twice where the registration is refined.
STAGES = (
    "cut", "expected_visibility", "field_of_view", "registration", "levelling", "semantics", "objects",
    "retiling", "heights", "bias", "residuals", "warp", "alignment", "displacements", "sigma", "lod",
    "candidate_pairs", "groups", "compare", "vegetation_null", "decide", "ground",
    "threshold_components", "patches", "changed", "refine", "labels",
)  # fmt: skip
Slice = TypeVar("Slice")
_RIM = NUMBERS.tiling.task_margin


@dataclass(frozen=True)
class ComparisonResult:
    """One comparison with one registration: keys of what it left, by stage and tile."""

    registration: str
    frame: Mapping[str, str]
    sigma: str
    lods: Mapping[str, str]
    compared: Mapping[str, str]
    decided: Mapping[str, str]
    ground: Mapping[str, str]
    patched: Mapping[str, str]
    reach: Mapping[str, Sequence[str]]
    patch_reach: Mapping[str, Sequence[str]]
    table: Table
    table_key: str


@dataclass
class ChangeRun(Epochs):
    """The comparison of two epochs in tiles.

    ``placed``: keys of the tiles of *before* in the frame of the pass at hand.
    """

    placed: dict[str, str] = field(default_factory=dict)

    def compare(
        self, registration: str, changed: Mapping[str, str] | None, span: tuple[float, float]
    ) -> ComparisonResult:
        """Compare the epochs at a registration; ``changed``: masks of an earlier pass by epoch and tile."""
        steps = np.linspace(*span, 11)
        spans = list(pairwise(steps.tolist()))
        frame, sigma, lods = self.place(registration, changed, (spans[0][0], spans[3][1]))
        links = self._per_tile("candidate_pairs", tile_links, CandidateSlice, self._linked(frame), spans[4])
        counts = self._counts()
        inputs = {**frame, **{f"candidate_pairs/{tile}": key for tile, key in links.items()}}
        config = slice_of(GroupSlice, self.config)
        params = GroupParams(WHOLE, self.size, self.sides, self.origin, config, counts)
        groups = self.runner.one(Task("groups", WHOLE, find_groups, inputs, params), spans[5])
        comparing, reach = self._groups(groups, frame, lods)
        grounds = self._tasks("ground", tile_ground, GroundSlice, self._seen(frame, lods))
        compared, ground = self.runner.together([comparing, grounds], (spans[6][0], spans[7][1]))
        patched, patch_reach = self._patches(ground, spans[8])
        decided = self._decide(compared, spans[8])
        trust = partial(rows_of_pair, simulated=self.simulated, config=self.config.confidence)
        table = build_table(self.runner, decided, patched, counts, self.origin, self._weaker(), trust)
        key = self.runner.put("table", WHOLE, table.columns)
        return ComparisonResult(
            registration,
            frame,
            sigma,
            lods,
            compared,
            decided,
            ground,
            patched,
            reach,
            patch_reach,
            table,
            key,
        )

    def place(
        self, registration: str, changed: Mapping[str, str] | None, span: tuple[float, float]
    ) -> tuple[dict[str, str], str, dict[str, str]]:
        """Bring *before* to *after*, remove smooth biases, and state what is left; arguments as for compare.

        Returns
        -------
        (dict, str, dict)
            Keys of the frame by alias, of sigma_reg, and of the levels of detection by tile.
        """
        spans = list(pairwise(np.linspace(*span, 5).tolist()))
        frame = {"registration": registration}
        self.placed = {}
        heights = self._per_tile("heights", tile_heights, PlacingSlice, self._pair(frame, 0, None), spans[0])
        frame["bias"] = self._reduce("bias", find_bias, PlacingSlice, "heights", heights, frame, spans[0])
        if self.config.placing.warp.enabled:
            around = self._pair(frame, 1, changed or {})
            residuals = self._per_tile("residuals", tile_residuals, DisplacementSlice, around, spans[1])
            frame["warp"] = self._reduce(
                "warp", find_warp, PlacingSlice, "residuals", residuals, frame, spans[1]
            )
        self.placed = self._place(frame, spans[1])
        around = self._pair(frame, 1, changed)
        found = self._per_tile("displacements", tile_displacements, DisplacementSlice, around, spans[2])
        sigma = self._reduce("sigma", find_sigma, PlacingSlice, "displacements", found, frame, spans[3])
        lod_inputs = {
            t: {**self._around(t, frame, 0), "sigma": sigma, "displacements": found[t], **self.poses}
            for t in self.tiles
        }
        return frame, sigma, self._per_tile("lod", tile_lods, LodSlice, lod_inputs, spans[3])

    def _place(self, frame: Mapping[str, str], span: tuple[float, float]) -> dict[str, str]:
        """Bring *before* into the frame; keys by tile."""
        side = self.sides[0]
        tasks = []
        for tile, key in self.points["before"].items():
            params = EpochTileParams(tile, self.size, side, self.origin)
            tasks.append(Task("alignment", tile, place_tile, {**frame, f"points/before/{tile}": key}, params))
        return self.runner.run(tasks, span)

    def _counts(self) -> tuple[int, int]:
        """Numbers of objects of *before* and of *after*."""
        before, after = (len(self.runner.load(EpochObjects, self.united[e]).points) for e in EPOCHS)
        return before, after

    def _weaker(self) -> str:
        return weakest(side.kind for side in self.sides)

    def _around(self, tile: str, frame: Mapping[str, str], rings: int) -> dict[str, str]:
        """Points of a tile and its neighbours, of both epochs, and the frame."""
        inputs = dict(frame)
        for epoch in EPOCHS:
            own = self.points[epoch]
            near = [tile, *neighbours(tile, own, rings)] if rings else [tile]
            inputs |= {f"points/{epoch}/{name}": own[name] for name in near if name in own}
            if epoch == "before":
                inputs |= {f"placed/before/{name}": self.placed[name] for name in near if name in self.placed}
        return inputs

    def _pair(
        self, frame: Mapping[str, str], rings: int, changed: Mapping[str, str] | None
    ) -> dict[str, dict[str, str]]:
        result = {}
        for tile in self.tiles:
            masks = {f"changed/{e}/{tile}": (changed or {}).get(f"changed/{e}/{tile}") for e in EPOCHS}
            result[tile] = {
                **self._around(tile, frame, rings), **{k: v for k, v in masks.items() if v is not None}
            }  # fmt: skip
        return result

    def _linked(self, frame: Mapping[str, str]) -> dict[str, dict[str, str]]:
        united = {f"united/{e}": self.united[e] for e in EPOCHS}
        return {tile: {**self._around(tile, frame, 1), **united} for tile in self.tiles}

    def _seen(self, frame: Mapping[str, str], lods: Mapping[str, str]) -> dict[str, dict[str, str]]:
        """All that a region of a tile and its neighbours wants, by tile."""
        common = self.common(frame["registration"])
        return {
            tile: self._region([tile, *neighbours(tile, self.tiles)], frame, lods, common, [tile])
            for tile in self.tiles
        }

    def _region(
        self,
        names: Sequence[str],
        frame: Mapping[str, str],
        lods: Mapping[str, str],
        common: CommonFrame,
        sight: Sequence[str],
    ) -> dict[str, str]:
        """Points and levels of detection of tiles, and the beams around some of them."""
        inputs = dict(frame)
        for name in names:
            inputs |= self._around(name, {}, 0)
            inputs[f"lods/{name}"] = lods[name]
        for name in sight:
            corners = corners_around(name, self.size, _RIM + SIGHT)
            inputs |= self.beams_at(self.sides[1], corners)
            inputs |= self.beams_at(self.sides[0], common.before_world(corners - self.origin))
        return inputs

    def _params(self, tile: str, config: type[Slice]) -> TileParams[Slice]:
        return TileParams(tile, self.size, self.sides, self.origin, slice_of(config, self.config))

    def _per_tile(
        self,
        stage: str,
        function: Callable[[Inputs, TileParams[Slice]], Any],
        config: type[Slice],
        inputs: Mapping[str, Mapping[str, str]],
        span: tuple[float, float],
    ) -> dict[str, str]:
        return self.runner.run(self._tasks(stage, function, config, inputs), span)

    def _tasks(
        self,
        stage: str,
        function: Callable[[Inputs, TileParams[Slice]], Any],
        config: type[Slice],
        inputs: Mapping[str, Mapping[str, str]],
    ) -> list[Task[TileParams[Slice]]]:
        return [Task(stage, tile, function, own, self._params(tile, config)) for tile, own in inputs.items()]

    def _reduce(
        self,
        stage: str,
        function: Callable[[Inputs, TileParams[Slice]], Any],
        config: type[Slice],
        alias: str,
        keys: Mapping[str, str],
        frame: Mapping[str, str],
        span: tuple[float, float],
    ) -> str:
        """Make one result of the results of all tiles."""
        inputs = {**frame, **{f"{alias}/{tile}": key for tile, key in keys.items()}}
        return self.runner.one(Task(stage, WHOLE, function, inputs, self._params(WHOLE, config)), span)

    def _groups(
        self, groups: str, frame: Mapping[str, str], lods: Mapping[str, str]
    ) -> tuple[list[Task[TileParams[ComparisonSlice]]], dict[str, list[str]]]:
        """Tasks that compare the groups of every tile that answers for some; and the tiles that each sees."""
        found = self.runner.load(CandidateGroups, groups)
        inputs, reach = {}, {}
        common = self.common(frame["registration"])
        low = found.low + self.origin[:2] - _RIM
        high = found.high + self.origin[:2] + _RIM
        for position, tile in enumerate(found.tiles):
            mine = np.flatnonzero(found.anchor == position).tolist()
            near = {n for g in mine for n in tiles_between(low[g], high[g], self.size)}
            names = sorted(near & set(self.tiles))
            inputs[tile] = {**self._region(names, frame, lods, common, names), "groups": groups, **self.paths}
            reach[tile] = names
        return self._tasks("compare", compare_tile, ComparisonSlice, inputs), reach

    def _decide(self, compared: Mapping[str, str], span: tuple[float, float]) -> dict[str, str]:
        """Decide plants against the plants of all tiles; keys of the rows by tile."""
        null = self._reduce(
            "vegetation_null", find_vegetation_null, PlantSlice, "compared", compared, {}, span
        )
        inputs = {tile: {"compared": key, "null": null} for tile, key in compared.items()}
        return self._per_tile("decide", decide_tile, PlantDecisionSlice, inputs, span)

    def _patches(
        self, ground: Mapping[str, str], span: tuple[float, float]
    ) -> tuple[dict[str, str], dict[str, list[str]]]:
        around = {
            tile: {f"ground/{n}": ground[n] for n in (tile, *neighbours(tile, ground))} for tile in ground
        }
        stage = "threshold_components"
        over = self._per_tile(stage, tile_over, PatchSlice, around, span)
        joined = self._reduce(stage, join_over, PatchSlice, stage, over, {}, span)
        begun = patch_tiles(self.runner.load(JoinedComponents, joined))
        config = slice_of(PatchSlice, self.config)
        tasks, reach = [], {}
        for tile, patches in sorted(begun.items()):
            names = sorted({n for patch in patches for n in patch.tiles})
            near = sorted({n for name in names for n in (name, *neighbours(name, ground))})
            inputs = {f"ground/{n}": ground[n] for n in near}
            inputs |= {f"over_labels/{n}": over[n] for n in near} | {"threshold_components": joined}
            params = PatchParams(tile, self.size, self.sides, self.origin, config, tuple(patches))
            tasks.append(Task("patches", tile, tile_patches, inputs, params))
            reach[tile] = names
        return self.runner.run(tasks, span), reach

    def changed(self, found: ComparisonResult, span: tuple[float, float]) -> dict[str, str]:
        """Masks of what a pass calls changed: keys by ``changed/<epoch>/<tile>``."""
        tasks = []
        config = slice_of(PatchSlice, self.config)
        for side in self.sides:
            for tile in sorted(self.points[side.epoch]):
                inputs = {**self._around(tile, found.frame, 0), **self._said(found, tile)}
                params = ChangedParams(tile, self.size, self.sides, self.origin, config, side)
                tasks.append(Task("changed", f"{side.epoch}/{tile}", tile_changed, inputs, params))
        keys = self.runner.run(tasks, span)
        return {f"changed/{name}": key for name, key in keys.items()}

    def _said(self, found: ComparisonResult, tile: str) -> dict[str, str]:
        """Name what a pass says of the points of a tile."""
        inputs = {"table": found.table_key}
        inputs |= {f"compared/{a}": found.compared[a] for a, names in found.reach.items() if tile in names}
        return inputs | {
            f"patched/{a}": found.patched[a] for a, names in found.patch_reach.items() if tile in names
        }

    def refine(
        self, first: ComparisonResult, changed: Mapping[str, str]
    ) -> tuple[str, float, tuple[str, ...]]:
        """Register again without what changed; key, largest shift [m], and a warning where that failed.

        That is one task: workers that would wait label points meanwhile, for it mostly moves nothing.
        """
        clouds = {f"cloud/{e}/{n}": k for e in EPOCHS for n, k in self.points[e].items()}
        inputs = {**clouds, **changed, "registration": first.registration}
        task = Task("refine", WHOLE, register_again, inputs, self.registering(None))
        beside = self._labels(first) if self.runner.executor.spare else []
        key = self.runner.together([[task], beside], (0.73, 0.76))[0][WHOLE]
        found = self.runner.load(PairRegistration, key)
        return key, found.shift, () if found.failed is None else (found.failed,)

    def label(self, found: ComparisonResult) -> dict[str, str]:
        """Label the points of every tile."""
        return self.runner.run(self._labels(found), (0.92, 0.97))

    def _labels(self, found: ComparisonResult) -> list[Task[TileParams[LabelSlice]]]:
        inputs = {
            tile: {**own, **self._said(found, tile), f"ground/{tile}": found.ground[tile]}
            for tile, own in self._seen(found.frame, found.lods).items()
        }
        return self._tasks("labels", label_tile, LabelSlice, inputs)

    def manifest(self, found: ComparisonResult, labelled: Mapping[str, str]) -> dict[str, Any]:
        """Return which piece is what: keys by stage, by epoch where stages look at one alone, and by tile."""
        return {
            "tile_m": self.size,
            "cut": self.clouds,
            "beams": self.beams,
            "registration": found.registration,
            "semantics": self.prepared,
            "objects": self.united,
            "points": self.points,
            "frame": dict(found.frame),
            "lod": dict(found.lods),
            "compare": dict(found.compared),
            "decide": dict(found.decided),
            "ground": dict(found.ground),
            "patches": dict(found.patched),
            "labels": dict(labelled),
        }

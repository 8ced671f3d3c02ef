"""The change run over the tiles of a city, stage by stage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from subiaco_change.config import ChangeConfig
from subiaco_change.observation.common_frame import CommonFrame
from subiaco_change.observation.evidence import evidence_kind, sight_corner
from subiaco_change.records import Registration
from subiaco_change.registration.pair import PairInfo
from subiaco_change.tiled.comparing import compare_tile
from subiaco_change.tiled.cutting import Side, cut_beams, cut_cloud, tiles_around
from subiaco_change.tiled.framing import in_frame, registration_of
from subiaco_change.tiled.ground import join_over, patch_tiles, tile_ground, tile_over, tile_patches
from subiaco_change.tiled.labels import label_tile, tile_changed
from subiaco_change.tiled.linking import find_groups, tile_links
from subiaco_change.tiled.placing import (
    find_bias,
    find_sigma,
    find_warp,
    tile_displacements,
    tile_heights,
    tile_lods,
    tile_residuals,
)
from subiaco_change.tiled.preparing import prepare_tile, recut_tile
from subiaco_change.tiled.registering import find_registration, register_again
from subiaco_change.tiled.sight import draw_tile, find_upright
from subiaco_change.tiled.table import Table, build_table
from subiaco_change.tiled.uniting import unite
from subiaco_geo.crs import transformer
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.maps import SurveyMap
from subiaco_geo.tiles import neighbours
from subiaco_geo.work.bench import Workbench
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Function, Task

#: Stages in their order; *compare* and what it rests on run twice where the registration is refined.
STAGES = (
    "cut", "sight", "registration", "recut", "upright", "semantics", "objects", "heights", "bias", "residuals",
    "warp", "displacements", "sigma", "lod", "links", "groups", "compare", "ground", "over", "patches",
    "changed", "second registration", "labels",
)  # fmt: skip
#: Slices of the configuration that each of the stages after *objects* reads.
_READS = {
    "heights": ("placing",),
    "bias": ("placing",),
    "residuals": ("placing", "lod"),
    "warp": ("placing",),
    "displacements": ("placing", "lod"),
    "sigma": ("placing",),
    "lod": ("placing", "lod", "without"),
    "links": ("measures", "association"),
    "groups": ("association",),
    "compare": ("evidence", "measures", "association", "decisions", "confidence", "without"),
    "ground": ("evidence", "ground"),
    "over": ("ground",),
    "patches": ("ground",),
    "changed": ("ground",),
    "labels": ("evidence", "ground", "measures", "without"),
}
_EPOCHS = ("before", "after")
_WEAKER = ("observed", "trajectory", "shadow", "assumed")
_SIGHT = 6.0  # beyond the points of a task, beams are looked up [m]
_SPANS = {"first": (0.50, 0.72), "second": (0.76, 0.92)}


@dataclass(frozen=True)
class Pass:
    """One comparison with one registration: keys of what it left, by stage and tile."""

    registration: str
    frame: Mapping[str, str]
    sigma: str
    lods: Mapping[str, str]
    compared: Mapping[str, str]
    ground: Mapping[str, str]
    patched: Mapping[str, str]
    reach: Mapping[str, Sequence[str]]
    patch_reach: Mapping[str, Sequence[str]]
    table: Table
    table_key: str


@dataclass
class CityRun:
    """Two checked epochs, their tiles, and the bench that works on them.

    Parameters
    ----------
    bench : Workbench
    config : ChangeConfig
    info : PairInfo
    given : tuple of str
        Fields of the points that replace a stage: ``semantic``, ``instance``.
    """

    bench: Workbench
    config: ChangeConfig
    info: PairInfo
    given: tuple[str, ...] = ()
    sides: tuple[Side, ...] = ()
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    clouds: dict[str, dict[str, str]] = field(default_factory=dict)
    beams: dict[str, dict[str, str]] = field(default_factory=dict)
    poses: dict[str, str] = field(default_factory=dict)
    prepared: dict[str, dict[str, str]] = field(default_factory=dict)
    united: dict[str, str] = field(default_factory=dict)

    @property
    def size(self) -> float:
        """Edge of a tile [m]."""
        return self.config.tiles.size

    @property
    def tiles(self) -> list[str]:
        """Tiles with points of either epoch, in order."""
        return sorted({*self.clouds["before"], *self.clouds["after"]})

    def cut(self, surveys: Sequence[SurveyMap]) -> None:
        """Cut both epochs, and what their evidence rests on, into tiles."""
        self.origin = np.asarray(surveys[1].cloud.origin, dtype=np.float64)
        sides = []
        for epoch, survey in zip(_EPOCHS, surveys, strict=True):
            self.clouds[epoch] = cut_cloud(self.bench, f"cut/{epoch}", survey.cloud, self.size)
            sides.append(self._side(epoch, survey))
            self._keep_poses(epoch, survey)
        self.sides = tuple(sides)

    def _side(self, epoch: str, survey: SurveyMap) -> Side:
        kind = evidence_kind(survey, self.config.evidence)
        origin = np.asarray(survey.cloud.origin, dtype=np.float64)
        side = Side(epoch, origin, survey.crs, kind, None, origin, self.config.evidence.voxel)
        self.beams[epoch] = {}
        if kind == "observed" and survey.visibility is not None:
            grid = survey.visibility
            other = self.info.beams_crs if epoch == "before" else None
            self.beams[epoch] = cut_beams(self.bench, f"beams/{epoch}", grid, self.size)
            return replace(side, beams_crs=other, corner=grid.origin, voxel=grid.voxel)
        if kind == "trajectory" and survey.trajectory is not None:
            low = survey.cloud.xyz.min(axis=0) + origin
            side = replace(side, corner=sight_corner(low, self.config.evidence))
            self.beams[epoch] = self._draw(side, survey.trajectory.positions)
        return side

    def _draw(self, side: Side, positions: Floats) -> dict[str, str]:
        """Draw the lines of sight of an epoch, tile by tile of its own frame."""
        own = self.clouds[side.epoch]
        way = self.bench.put("trajectory", side.epoch, {"positions": positions})
        rings = math.ceil(self.config.evidence.max_range / self.size)
        near = {n for name in own for n in (name, *self._ring(name, rings))}
        tasks = []
        for name in sorted(near):
            around = [n for n in (name, *neighbours(name, own, rings)) if n in own]
            inputs = {"trajectory": way, **{f"cloud/{n}": own[n] for n in around}}
            params = {"tile": name, "size": self.size, "side": side, "config": self.config.evidence}
            tasks.append(Task("sight", name, draw_tile, inputs, params))
        return self.bench.run(tasks, (0.02, 0.05))

    def _ring(self, name: str, rings: int) -> list[str]:
        column, row = (int(v) for v in name.split("_"))
        reach = range(-rings, rings + 1)
        return [f"{column + c}_{row + r}" for c in reach for r in reach]

    def _keep_poses(self, epoch: str, survey: SurveyMap) -> None:
        """Keep the pose covariances of a map, where it carries them."""
        found = survey.uncertainty
        if found is None or survey.trajectory is None or len(found.times_ns) == 0:
            return
        positions = survey.trajectory.at(found.times_ns)[:, :3, 3]
        arrays = {"positions": positions, "covariances": found.covariances}
        self.poses[f"poses/{epoch}"] = self.bench.put("poses", epoch, arrays)

    def register(self, transform: Floats | None) -> str:
        """Register the epochs and cut *before* anew, by the tiles of *after*; return the key."""
        params = {"sides": self.sides, "config": self._slice("registration", "registration_points", "leaf")}
        task = Task(
            "registration", "all", find_registration, self._all_clouds(), {**params, "transform": transform}
        )
        key = self.bench.one(task, (0.05, 0.15))
        registration = self.registration(key)
        same = np.array_equal(self.sides[0].origin, self.sides[1].origin)
        if not (same and np.array_equal(registration.T_local, np.eye(4))):
            self._recut(key, registration)
        return key

    def registration(self, key: str) -> Registration:
        """Return the registration under a key."""
        return registration_of(self.bench.store.load(key))

    def _recut(self, key: str, registration: Registration) -> None:
        own, side = self.clouds["before"], self.sides[0]
        frame = CommonFrame(registration, self.origin)
        wanted: dict[str, set[str]] = {}
        for name in own:
            xyz = self.bench.store.load(own[name])["xyz"]
            low, high = xyz.min(axis=0), xyz.max(axis=0)
            corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
            moved = in_frame(corners, side, frame).world()[:, :2]
            first = np.floor(moved.min(axis=0) / self.size).astype(int)
            last = np.floor(moved.max(axis=0) / self.size).astype(int)
            for column in range(first[0], last[0] + 1):
                for row in range(first[1], last[1] + 1):
                    wanted.setdefault(f"{column}_{row}", set()).add(name)
        tasks = []
        for tile, names in sorted(wanted.items()):
            inputs = {"registration": key, **{f"cloud/{n}": own[n] for n in sorted(names)}}
            params = {"tile": tile, "size": self.size, "side": side, "origin": self.origin}
            tasks.append(Task("recut", tile, recut_tile, inputs, params))
        keys = self.bench.run(tasks, (0.15, 0.16))
        self.clouds["before"] = {n: k for n, k in keys.items() if len(self.bench.store.load(k)["xyz"])}

    def prepare(self, registration: str) -> None:
        """Label every tile of both epochs, and number their objects."""
        config = self._slice(
            "semantics", "instances", "evidence", "leaf", "normal_radius", "without", "measures"
        )
        turn = self._upright()
        tasks = []
        for side in self.sides:
            own = self.clouds[side.epoch]
            for name in sorted(own):
                around = [name, *neighbours(name, own)]
                params = {
                    "tile": name, "side": side, "origin": self.origin, "config": config, "turn": turn,
                    "size": self.size, "overlap": self.config.tiles.overlap, "edge": self.config.tiles.edge,
                    "given": self.given,
                }  # fmt: skip
                inputs = {f"cloud/{n}": own[n] for n in around} | {"registration": registration}
                inputs |= self._beams(side, {"registration": registration}, *self._box(name, around))
                tasks.append(Task("semantics", f"{side.epoch}_{name}", prepare_tile, inputs, params))
        keys = self.bench.run(tasks, (0.16, 0.48))
        for epoch in _EPOCHS:
            self.prepared[epoch] = {n: keys[f"{epoch}_{n}"] for n in self.clouds[epoch]}
            inputs = {f"prepared/{n}": k for n, k in self.prepared[epoch].items()}
            given = {"given": "instance" in self.given}
            self.united[epoch] = self.bench.one(Task("objects", epoch, unite, inputs, given), (0.48, 0.5))

    def _upright(self) -> Floats | None:
        """Return the rotation that makes local clouds upright, if they are not."""
        side = self.sides[1]
        if side.crs is not None:
            return None
        inputs = {f"cloud/{n}": k for n, k in self.clouds["after"].items()}
        key = self.bench.one(Task("upright", "after", find_upright, inputs, {"side": side}), (0.16, 0.16))
        found = self.bench.store.load(key)
        return np.asarray(found["turn"]) if "turn" in found else None

    def compare(
        self, registration: str, changed: Mapping[str, str] | None, span: tuple[float, float]
    ) -> Pass:
        """Compare the epochs at a registration; ``changed`` are masks of an earlier pass by epoch and tile."""
        steps = np.linspace(*span, 11)
        spans = list(zip(steps[:-1], steps[1:], strict=True))
        frame = {"registration": registration}
        frame["bias"] = self._smooth("heights", tile_heights, "bias", find_bias, frame, spans[0])
        if self.config.placing.warp.enabled:
            more = changed or {}
            frame["warp"] = self._smooth("residuals", tile_residuals, "warp", find_warp, frame, spans[1], more)
        found = self._per_tile("displacements", tile_displacements, self._pair(frame, 1, changed), spans[2])
        sigma = self._reduce("sigma", find_sigma, "displacements", found, frame, spans[3])
        lod_inputs = {
            t: {**self._around(t, frame, 0), "sigma": sigma, "displacements": found[t], **self.poses}
            for t in self.tiles
        }
        lods = self._per_tile("lod", tile_lods, lod_inputs, spans[3])
        links = self._per_tile("links", tile_links, self._linked(frame), spans[4])
        counts = [len(self.bench.store.load(self.united[e])["points"]) for e in _EPOCHS]
        groups = self._reduce("groups", find_groups, "links", links, frame, spans[5], counts=tuple(counts))
        compared, reach = self._compare_groups(groups, frame, lods, spans[6])
        ground = self._per_tile("ground", tile_ground, self._seen(frame, lods, 1, sight=False), spans[7])
        patched, patch_reach = self._patches(ground, spans[8])
        table = build_table(self.bench.store, compared, patched, counts, self.origin, self._weaker())
        key = self.bench.put("table", "all", table.arrays)
        return Pass(
            registration, frame, sigma, lods, compared, ground, patched, reach, patch_reach, table, key
        )

    def _weaker(self) -> str:
        return max((side.kind for side in self.sides), key=_WEAKER.index)

    def _slice(self, *names: str) -> SimpleNamespace:
        """Keep of the configuration what a stage reads: another setting elsewhere redoes nothing."""
        return SimpleNamespace(**{name: getattr(self.config, name) for name in names})

    def _all_clouds(self) -> dict[str, str]:
        return {f"cloud/{e}/{n}": k for e in _EPOCHS for n, k in self.clouds[e].items()}

    def _around(self, tile: str, frame: Mapping[str, str], rings: int) -> dict[str, str]:
        """Points and classes of a tile and its neighbours, of both epochs, and the frame."""
        inputs = dict(frame)
        for epoch in _EPOCHS:
            own = self.clouds[epoch]
            names = [tile, *neighbours(tile, own, rings)] if rings else [tile]
            for name in names:
                if name in own:
                    inputs[f"cloud/{epoch}/{name}"] = own[name]
                    inputs[f"prepared/{epoch}/{name}"] = self.prepared[epoch][name]
        return inputs

    def _pair(
        self, frame: Mapping[str, str], rings: int, changed: Mapping[str, str] | None
    ) -> dict[str, dict[str, str]]:
        result = {}
        for tile in self.tiles:
            masks = {f"changed/{e}/{tile}": (changed or {}).get(f"changed/{e}/{tile}") for e in _EPOCHS}
            result[tile] = {
                **self._around(tile, frame, rings), **{k: v for k, v in masks.items() if v is not None}
            }  # fmt: skip
        return result

    def _linked(self, frame: Mapping[str, str]) -> dict[str, dict[str, str]]:
        united = {f"united/{e}": self.united[e] for e in _EPOCHS}
        return {tile: {**self._around(tile, frame, 1), **united} for tile in self.tiles}

    def _seen(
        self, frame: Mapping[str, str], lods: Mapping[str, str], rings: int, *, sight: bool = True
    ) -> dict[str, dict[str, str]]:
        """All that a region of a tile and its neighbours wants."""
        result = {}
        for tile in self.tiles:
            around = [tile, *neighbours(tile, self.tiles, rings)]
            result[tile] = self._region(around, frame, lods, self._box(tile, around), sight=sight)
        return result

    def _region(
        self,
        names: Sequence[str],
        frame: Mapping[str, str],
        lods: Mapping[str, str],
        box: tuple[Floats, Floats],
        *,
        sight: bool = True,
    ) -> dict[str, str]:
        inputs = {**frame, **{f"united/{e}": self.united[e] for e in _EPOCHS}}
        for name in names:
            inputs |= self._around(name, {}, 0)
            inputs[f"lods/{name}"] = lods[name]
        if sight:
            for side in self.sides:
                inputs |= self._beams(side, frame, *box)
        return inputs

    def _box(self, tile: str, around: Sequence[str]) -> tuple[Floats, Floats]:
        """Box in the common frame around a tile [m]: as far as its tasks look."""
        del around
        low = np.array([int(v) for v in tile.split("_")], dtype=np.float64) * self.size
        rim = max(self.config.tiles.overlap, 10.0)
        return low - rim - self.origin[:2], low + self.size + rim - self.origin[:2]

    def _beams(self, side: Side, frame: Mapping[str, str], low: Floats, high: Floats) -> dict[str, str]:
        """Tiles of beams of an epoch around a box (2,), (2,) of the common frame."""
        known = self.beams[side.epoch]
        if not known:
            return {}
        heights = (-50.0, 50.0)
        corners = np.array(
            [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in heights]
        )
        world = corners + self.origin
        if side.epoch == "before":
            world = CommonFrame(self.registration(frame["registration"]), self.origin).before_world(corners)
        if side.beams_crs is not None:
            world = transformer(str(side.crs), side.beams_crs).apply(world)
        names = tiles_around(
            world[:, :2].min(axis=0) - _SIGHT, world[:, :2].max(axis=0) + _SIGHT, self.size, known
        )
        return {f"beams/{side.epoch}/{n}": known[n] for n in names}

    def _params(self, stage: str, tile: str, **more: Any) -> dict[str, Any]:
        config = self._slice(*_READS[stage])
        return {
            "tile": tile, "size": self.size, "sides": self.sides, "origin": self.origin, "config": config, **more,
        }  # fmt: skip

    def _per_tile(
        self,
        stage: str,
        function: Function,
        inputs: Mapping[str, Mapping[str, str]],
        span: tuple[float, float],
        **more: Any,
    ) -> dict[str, str]:
        tasks = [Task(stage, tile, function, own, self._params(stage, tile, **more)) for tile, own in inputs.items()]
        return self.bench.run(tasks, span)

    def _reduce(
        self,
        stage: str,
        function: Function,
        alias: str,
        keys: Mapping[str, str],
        frame: Mapping[str, str],
        span: tuple[float, float],
        **more: Any,
    ) -> str:
        inputs = {**frame, **{f"{alias}/{tile}": key for tile, key in keys.items()}}
        return self.bench.one(Task(stage, "all", function, inputs, self._params(stage, "all", **more)), span)

    def _smooth(
        self,
        alias: str,
        function: Function,
        stage: str,
        reduce: Function,
        frame: Mapping[str, str],
        span: tuple[float, float],
        changed: Mapping[str, str] | None = None,
    ) -> str:
        """Hand numbers of all tiles up, and make a smooth field of them."""
        rings = 0 if changed is None else 1
        keys = self._per_tile(alias, function, self._pair(frame, rings, changed), span)
        return self._reduce(stage, reduce, alias, keys, frame, span)

    def _compare_groups(
        self, groups: str, frame: Mapping[str, str], lods: Mapping[str, str], span: tuple[float, float]
    ) -> tuple[dict[str, str], dict[str, list[str]]]:
        """Compare the groups of every tile that answers for some; and the tiles that each looks at."""
        found = self.bench.store.load(groups)
        inputs, reach = {}, {}
        known = dict.fromkeys(self.tiles, "")
        rim = 10.0
        low, high, anchor = found["low"], found["high"], found["anchor"]
        for position, tile in enumerate(found["tiles"].tolist()):
            mine = np.flatnonzero(anchor == position)
            names: set[str] = set()
            for g in mine.tolist():
                world = low[g] - rim + self.origin[:2], high[g] + rim + self.origin[:2]
                names.update(tiles_around(*world, self.size, known))
            box = low[mine].min(axis=0) - rim, high[mine].max(axis=0) + rim
            inputs[tile] = {**self._region(sorted(names), frame, lods, box), "groups": groups}
            reach[tile] = sorted(names)
        return self._per_tile("compare", compare_tile, inputs, span), reach

    def _patches(
        self, ground: Mapping[str, str], span: tuple[float, float]
    ) -> tuple[dict[str, str], dict[str, list[str]]]:
        around = {
            tile: {f"ground/{n}": ground[n] for n in (tile, *neighbours(tile, ground))} for tile in ground
        }
        over = self._per_tile("over", tile_over, around, span)
        joined = self._reduce("over", join_over, "over", over, {}, span)
        begun = patch_tiles(self.bench.store.load(joined))
        tasks, reach = [], {}
        for tile, patches in sorted(begun.items()):
            names = sorted({n for _, _, own in patches for n in own})
            near = sorted({n for name in names for n in (name, *neighbours(name, ground))})
            inputs = {f"ground/{n}": ground[n] for n in near}
            inputs |= {f"over_labels/{n}": over[n] for n in near} | {"over": joined}
            tasks.append(
                Task("patches", tile, tile_patches, inputs, self._params("patches", tile, patches=patches))
            )
            reach[tile] = names
        return self.bench.run(tasks, span), reach

    def changed(self, found: Pass, span: tuple[float, float]) -> dict[str, str]:
        """Masks of what a pass calls changed: keys by ``changed/<epoch>/<tile>``."""
        tasks = []
        for side in self.sides:
            for tile in sorted(self.clouds[side.epoch]):
                inputs = {**self._around(tile, found.frame, 0), **self._said(found, tile)}
                params = self._params("changed", tile, side=side)
                tasks.append(Task("changed", f"{side.epoch}/{tile}", tile_changed, inputs, params))
        keys = self.bench.run(tasks, span)
        return {f"changed/{name}": key for name, key in keys.items()}

    def _said(self, found: Pass, tile: str) -> dict[str, str]:
        """What a pass says of the points of a tile."""
        inputs = {"table": found.table_key}
        inputs |= {f"compared/{a}": found.compared[a] for a, names in found.reach.items() if tile in names}
        return inputs | {
            f"patched/{a}": found.patched[a] for a, names in found.patch_reach.items() if tile in names
        }

    def refine(self, first: Pass, changed: Mapping[str, str]) -> tuple[str, float, tuple[str, ...]]:
        """Register again without what changed; key, largest shift [m], and a warning where that failed."""
        inputs = {**self._all_clouds(), **changed, "registration": first.registration}
        params = {"sides": self.sides, "config": self._slice("registration", "registration_points", "leaf")}
        key = self.bench.one(Task("second registration", "all", register_again, inputs, params), (0.73, 0.76))
        found = self.bench.store.load(key)
        return key, float(found["shift"]), (str(found["failed"]),) if "failed" in found else ()

    def label(self, found: Pass) -> dict[str, str]:
        """Label the points of every tile."""
        inputs = {
            tile: {**own, **self._said(found, tile), f"ground/{tile}": found.ground[tile]}
            for tile, own in self._seen(found.frame, found.lods, 1).items()
        }
        return self._per_tile("labels", label_tile, inputs, (0.92, 0.97))

    def load(self, key: str) -> Arrays:
        """Return what a task left."""
        return self.bench.store.load(key)


def check_given(surveys: Sequence[SurveyMap], given: Sequence[str]) -> tuple[str, ...]:
    """Return the fields of points that replace stages.

    Raises
    ------
    InputError
        An epoch lacks one.
    """
    for epoch, survey in zip(_EPOCHS, surveys, strict=True):
        for name in given:
            if name not in survey.cloud.fields:
                raise InputError(f"{epoch}: no point field {name!r} to take as given; name it so in the file")
    return tuple(given)

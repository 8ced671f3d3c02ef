"""Stages of both epochs before the comparison: tiling, registration, segmentation, retiling."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.constants import foot

from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.driven_lane import SurveyPath
from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules import rules_of_stages
from subiaco_change.point_spacing import PointSpacing, at_spacing, spacing_scale
from subiaco_change.records import Registration
from subiaco_change.registration.pair import (
    PairInfo,
    agree,
    check_extents,
    check_places,
    lowest_points,
    moved_trajectory,
    refuse_height_offset,
    shares_origin,
)
from subiaco_change.survey_places import GroundDensity, SensorPlaces, survey_places
from subiaco_change.tiling.alignment import StatedPoses
from subiaco_change.tiling.epoch_preparation import (
    LevellingParams,
    NeedsParams,
    RenderParams,
    TileTrails,
    TileViews,
    TrailParams,
    find_needs,
    find_trails,
    find_upright,
    render_tile,
)
from subiaco_change.tiling.epoch_tiles import (
    EPOCHS,
    CutBeams,
    CutCloud,
    EpochContext,
    TilePoints,
    corners,
    cut_beams,
    cut_cloud,
    tiles_between,
)
from subiaco_change.tiling.registration_stage import RegistrationParams, RegistrationSlice, find_registration
from subiaco_change.tiling.retiling import EpochTileParams, LabelledPoints, MergingParams, recut_tile, unite
from subiaco_change.tiling.stage_inputs import PairRegistration, in_frame, slice_of
from subiaco_change.tiling.tile_segmentation import SegmentationParams, SegmentationSlice, prepare_tile
from subiaco_change.view_from_above import ColumnCounts, seen_from_above
from subiaco_change.visibility_evidence import EvidenceKind, evidence_kind
from subiaco_geo.clouds import distance_to_box
from subiaco_geo.crs import Transform, transformer
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.frames import Floats
from subiaco_geo.free_space.expected_visibility import occupied_columns, occupied_corner, sample_poses
from subiaco_geo.free_space.sensor_view import SensorView, described_view, spin_headings
from subiaco_geo.free_space.view_estimation import ViewHistogram, estimate_view, with_blind_arcs
from subiaco_geo.simulated import SIMULATIONS
from subiaco_geo.sources import Epoch, EpochFiles
from subiaco_geo.tiles import neighbours, split_by_tile, tile_named
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.work.executors import Start, work_beside
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import WHOLE, Task

_LOG = logging.getLogger(__name__)
#: Name of an epoch in the stages that look at one alone.
ALONE = "epoch"
#: Beyond the points of a task, beams are looked up so far [m].
SIGHT = NUMBERS.tiling.beam_reach
_HEIGHT_TILES = NUMBERS.tiling.height_tiles
_BEAMS = 0.5  # edge of a tile of counted beams, of a tile of points: tasks read few that are too far


@dataclass(frozen=True)
class _Cutting:
    """The evidence of an epoch, and calls that wait for its cut points and for its cut beams."""

    kind: EvidenceKind
    points: Callable[[], CutCloud]
    beams: Callable[[], CutBeams | None]


@dataclass
class Epochs:
    """Two checked epochs, their tiles, and the runner that works on them.

    Parameters
    ----------
    runner : TaskRunner
    config : ChangeConfig
    given : tuple of str
        Fields of the points that replace a stage: ``semantic``, ``instance``.
    info : PairInfo
        What was done to bring them together, once they are cut.
    """

    runner: TaskRunner
    config: ChangeConfig
    given: tuple[str, ...] = ()
    info: PairInfo = field(default_factory=lambda: PairInfo(None))
    sides: tuple[EpochContext, ...] = ()
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    clouds: dict[str, dict[str, str]] = field(default_factory=dict)
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)
    beams: dict[str, dict[str, str]] = field(default_factory=dict)
    beam_edge: dict[str, float] = field(default_factory=dict)
    trails: dict[str, dict[str, str]] = field(default_factory=dict)
    poses: dict[str, str] = field(default_factory=dict)
    paths: dict[str, str] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)
    prepared: dict[str, dict[str, str]] = field(default_factory=dict)
    united: dict[str, str] = field(default_factory=dict)
    points: dict[str, dict[str, str]] = field(default_factory=dict)
    lit: dict[str, bool] = field(default_factory=dict)
    simulated: bool = False
    sizes: dict[str, dict[str, int]] = field(default_factory=dict)  # points by epoch and tile, at the leaf
    input_points: int = 0  # of both epochs, of all tiles
    extents: tuple[tuple[Floats, Floats], ...] = ()  # lowest and highest coordinates (3,) of each epoch

    @property
    def size(self) -> float:
        """Edge of a tile [m]."""
        return self.config.tiles.size

    @property
    def tiles(self) -> list[str]:
        """Tiles with points of either epoch, in order."""
        return sorted({*self.points["before"], *self.points["after"]})

    @property
    def kept_points(self) -> int:
        """Points of both epochs at the working leaf."""
        return sum(size for own in self.sizes.values() for size in own.values())

    def keep_largest(self, count: int) -> list[str]:
        """Leave out all tiles but those with the most points, and their neighbours; return the names kept.

        Raises
        ------
        InputError
            Two clouds without CRS, whose tiles need not lie at the same places.
        """
        if any(side.crs is None for side in self.sides):
            raise InputError("the largest tiles of clouds without CRS are not at one place; run the whole")
        total: Counter[str] = Counter()
        for own in self.sizes.values():
            total.update(own)
        largest = [name for name, _ in sorted(total.items(), key=lambda item: (-item[1], item[0]))[:count]]
        kept = sorted({*largest, *(n for name in largest for n in neighbours(name, total))})
        for epoch in EPOCHS:
            self.clouds[epoch] = {n: key for n, key in self.clouds[epoch].items() if n in kept}
            self.sizes[epoch] = {n: size for n, size in self.sizes[epoch].items() if n in kept}
        return kept

    def cut(self, epochs: Sequence[Epoch]) -> None:
        """Cut both epochs, and what their evidence rests on, into tiles.

        Raises
        ------
        InputError
            An empty cloud, coordinates that are no numbers, CRS that PROJ can only guess between,
            or georeferenced epochs whose extents are disjoint.
        """
        before, after = epochs
        self.simulated = all(epoch.info.get(SIMULATIONS) for epoch in epochs)
        self.info, operation = agree(before.crs, after.crs)
        both = before.crs is not None and after.crs is not None
        if before.crs is not None and after.crs is not None:
            check_places(before.origin, after.origin, before.crs, after.crs, operation)
        self.origin = after.origin
        shared = shares_origin(before.origin, after.origin, both)
        origins = (after.origin if shared else before.origin, after.origin)
        operations = (operation, None)
        extents, sides = [], []
        with TemporaryDirectory(prefix="subiaco_") as folder, work_beside(self.runner.executor) as start:
            cutting = [
                self._begin_cut(epoch, origin, own, start, Path(folder))
                for epoch, origin, own in zip(epochs, origins, operations, strict=True)
            ]
            for name, epoch, origin, own, begun in zip(
                EPOCHS, epochs, origins, operations, cutting, strict=True
            ):
                found = self._cut_points(name, epoch, begun)
                extents.append((found.low, found.high))
                crs = epoch.crs if self.info.crs is None else self.info.crs
                sides.append(self._side(name, epoch, origin, crs, found, own, begun))
        if both:
            check_extents(extents[0], extents[1])
        self.sides = tuple(sides)
        self.extents = tuple(extents)

    def check_heights(self) -> None:
        """Refuse georeferenced epochs whose heights are of two kinds, from tiles that both have.

        Raises
        ------
        InputError
            See :func:`~subiaco_change.registration.pair.refuse_height_offset`.
        """
        if self.info.crs is None:
            return
        shared = sorted(self.clouds["before"].keys() & self.clouds["after"].keys())
        chosen = shared[:: max(len(shared) // _HEIGHT_TILES, 1)]
        low: list[dict[tuple[int, int], float]] = [{}, {}]
        for e, side in enumerate(self.sides):
            for name in chosen:
                low[e] |= lowest_points(self._cloud(side.epoch, name).xyz + side.origin)
        refuse_height_offset(low[0], low[1])

    def follow_spacing(self) -> None:
        """Raise the lengths of the configuration to what the sparser epoch can show, once both are cut."""
        above = all(side.from_above for side in self.sides)
        self.config = at_spacing(self.config, round(self.spacing.coarser, 2), from_above=above)

    @property
    def spacing(self) -> PointSpacing:
        """Spacing of the points of both epochs, once they are cut."""
        return PointSpacing(*(side.spacing for side in self.sides))

    def _begin_cut(
        self, epoch: Epoch, origin: Floats, operation: Transform | None, start: Start, folder: Path
    ) -> _Cutting:
        """Begin to cut points and beams of an epoch, in other processes where these can read it alike.

        Given classes are counted as they are read, and operations between CRS cannot be handed on.
        """
        way, config, store = epoch.trajectory, self.config, self.runner.store
        if operation is not None or not isinstance(epoch, EpochFiles) or not store.shared:
            start = partial
        points = start(
            cut_cloud, store, epoch, origin, self.size, config.leaf, config.every_point, folder, operation
        )
        kind = evidence_kind(epoch.has_beams, way, config.evidence)
        if kind != "observed":
            return _Cutting(kind, points, lambda: None)
        return _Cutting(kind, points, start(cut_beams, store, epoch, _BEAMS * self.size, folder))

    def _cut_points(self, name: str, epoch: Epoch, begun: _Cutting) -> CutCloud:
        try:
            found = begun.points()
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        if found.points == 0:
            raise InputError(f"{name}: the cloud is empty; check the file")
        _refuse_no_survey(_named(name, epoch, "cloud"), epoch.crs, found, self.config.registration.min_points)
        self.clouds[name], self.inputs[name], self.sizes[name] = found.keys, found.inputs, found.sizes
        self.input_points += found.points
        for field_name in self.given:
            if any(getattr(self._cloud(name, tile), field_name) is None for tile in found.keys):
                raise InputError(
                    f"{name}: no point field {field_name!r} to take as given; name it so in the file"
                )
        return found

    def _side(
        self,
        name: str,
        epoch: Epoch,
        origin: Floats,
        crs: str | None,
        cut: CutCloud,
        operation: Transform | None,
        begun: _Cutting,
    ) -> EpochContext:
        """Cut what the evidence of an epoch rests on, and tell what tasks must know of it."""
        config = self.config.evidence
        way = epoch.trajectory
        if way is not None and operation is not None:
            way = moved_trajectory(way, operation)
        kind = begun.kind
        side = EpochContext(name, origin, crs, kind, None, origin, config.poses.occupied, cut.spacing)
        self.trails[name] = {} if kind == "observed" else self._trails(side)
        self.beams[name], self.beam_edge[name] = {}, self.size
        self._keep_poses(name, epoch, way)
        if kind == "observed":
            other = self.info.beams_crs if name == "before" else None
            beams = begun.beams()
            if beams is not None:
                self.beam_edge[name], self.beams[name] = _BEAMS * self.size, beams.keys
                side = replace(side, beams_crs=other, corner=beams.corner, voxel=beams.voxel)
        elif kind == "shadow":
            columns, ground = self._shape(name)
            side = replace(side, from_above=seen_from_above(columns))
            if config.source == "auto" and not side.from_above:
                side = self._from_places(side, cut, survey_places(ground))
        elif kind == "trajectory" and way is not None:
            _refuse_elsewhere(_named(name, epoch, "trajectory_file"), way, cut, config.poses.max_range)
            side = replace(side, corner=occupied_corner(cut.low, config.poses))
            poses = way.poses[sample_poses(way.positions, config.poses.pose_spacing)]
            self.beams[name] = self._render(side, poses)
            side = replace(side, view=self._view(side, epoch, way))
        return side

    def _view(self, side: EpochContext, epoch: Epoch, way: Trajectory) -> SensorView:
        """Take the sensor that a map describes, or estimate it from what its points need."""
        config = self.config.evidence.poses
        columns = [np.zeros((0, 2))]
        views = self.beams[side.epoch]
        for key in views.values():
            piece = self.runner.load(TileViews, key)
            columns.append(occupied_columns(piece.occupied, side.corner, side.voxel))
        view = described_view(epoch.info) or estimate_view(self._needs(side, views), config)
        return with_blind_arcs(view, way.poses, np.concatenate(columns), config)

    def _from_places(self, side: EpochContext, cut: CutCloud, places: Floats) -> EpochContext:
        """Find what the sensor of a bare cloud saw from estimated places (K, 3), if there are any."""
        name, config = side.epoch, self.config.evidence.poses
        if len(places) == 0:
            return side
        _LOG.info("%s: places of the sensor estimated from the ground: %d", name, len(places))
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        poses[:, :3, 3] = places
        seeing = replace(side, kind="estimated", corner=occupied_corner(cut.low, config))
        views = self._render(seeing, poses)
        self.beams[name] = views
        self.places[f"places/{name}"] = self.runner.put("places", name, SensorPlaces(places))
        return replace(seeing, view=estimate_view(self._needs(seeing, views), config))

    def _needs(self, side: EpochContext, views: Mapping[str, str]) -> list[ViewHistogram]:
        """Count what the points of an epoch need of its sensor, tile by tile."""
        own, config = self.clouds[side.epoch], self.config.evidence.poses
        moved, rings = self.config.semantics.traffic.probability, math.ceil(config.max_range / self.size)
        tasks = []
        for name in sorted(own):
            inputs = {f"cloud/{name}": own[name]}
            if name in self.trails[side.epoch]:
                inputs[f"trails/{name}"] = self.trails[side.epoch][name]
            inputs |= {f"views/{n}": views[n] for n in (name, *neighbours(name, views, rings))}
            tasks.append(
                Task("field_of_view", name, find_needs, inputs, NeedsParams(name, side, config, moved))
            )
        return [self.runner.load(ViewHistogram, key) for key in self.runner.run(tasks, (0.05, 0.06)).values()]

    def _shape(self, name: str) -> tuple[list[ColumnCounts], list[GroundDensity]]:
        """Return what the columns and the ground of the tiles of an epoch hold."""
        tiles = (self.runner.load(TileTrails, key) for _, key in sorted(self.trails[name].items()))
        pairs = [(tile.columns, tile.ground) for tile in tiles]
        return [columns for columns, _ in pairs], [ground for _, ground in pairs]

    def _trails(self, side: EpochContext) -> dict[str, str]:
        """Tell ghost trails by their shape, where nothing counted beams."""
        own, semantics = self.clouds[side.epoch], self.config.semantics
        shape = semantics.trail_shape
        shape = shape.model_copy(update={"cell": shape.cell * spacing_scale(side.spacing)})
        semantics = semantics.model_copy(update={"trail_shape": shape})
        alone = replace(side, epoch=ALONE)
        upright = self._upright(alone, own)
        off = rules_of_stages(self.config.rules_off, SegmentationSlice.RULE_STAGES)
        tasks = []
        for name in sorted(own):
            inputs = {f"cloud/{n}": own[n] for n in (name, *neighbours(name, own))} | upright
            params = TrailParams(name, self.size, alone, semantics, off)
            tasks.append(Task("trails", name, find_trails, inputs, params))
        return self.runner.run(tasks, (0.02, 0.03))

    def _render(self, side: EpochContext, poses: Floats) -> dict[str, str]:
        """Render what the poses of an epoch must have seen, tile by tile of its own frame."""
        own, config = self.clouds[side.epoch], self.config.evidence.poses
        headings = spin_headings(poses[:, :3, :3])
        by_tile = split_by_tile(poses[:, :3, 3], self.size)
        rings = math.ceil(config.max_range / self.size)
        moved = self.config.semantics.traffic.probability
        tasks = []
        for name in sorted({*own, *by_tile}):
            here = by_tile.get(name, np.zeros(0, dtype=np.int64))
            looking = poses[here]
            around = [name, *(neighbours(name, own, rings) if len(looking) else ())]
            inputs = {f"cloud/{n}": own[n] for n in around if n in own}
            inputs |= {f"trails/{n}": self.trails[side.epoch][n] for n in around if n in own}
            params = RenderParams(name, self.size, side, config, looking, headings[here], moved)
            tasks.append(Task("expected_visibility", name, render_tile, inputs, params))
        return self.runner.run(tasks, (0.02, 0.05))

    def _keep_poses(self, name: str, epoch: Epoch, way: Trajectory | None) -> None:
        """Keep the path of the survey vehicle, and the pose covariances of a map, where it carries them."""
        if way is not None and len(way) > 0:
            self.paths[f"path/{name}"] = self.runner.put("paths", name, SurveyPath(way.positions))
        found = epoch.uncertainty
        if found is None or way is None or len(found.times_ns) == 0:
            return
        positions = way.at(found.times_ns)[:, :3, 3]
        stated = StatedPoses(positions, found.covariances)
        self.poses[f"poses/{name}"] = self.runner.put("poses", name, stated)

    def register(self, transform: Floats | None) -> str:
        """Register the epochs, and beside it label every tile of each in its own frame; return the key."""
        clouds = {f"cloud/{e}/{n}": k for e in EPOCHS for n, k in self.clouds[e].items()}
        task = Task("registration", WHOLE, find_registration, clouds, self.registering(transform))
        stages: list[Sequence[Task[Any]]] = [[task], *(self._semantics(side) for side in self.sides)]
        try:
            found, *prepared = self.runner.together(stages, (0.05, 0.47))
        except RegistrationError as error:
            if self.info.crs is not None:
                raise
            raise RegistrationError(f"{error}{_feet_hint(*self.extents)}") from error
        self.prepared = dict(zip(EPOCHS, prepared, strict=True))
        for warning in self.registration(found[WHOLE]).warnings:
            _LOG.warning("registration: %s", warning)
        return found[WHOLE]

    def registering(self, transform: Floats | None) -> RegistrationParams:
        """Return the parameters of a registration, or of a given transform."""
        return RegistrationParams(self.sides, slice_of(RegistrationSlice, self.config), transform)

    def common(self, key: str) -> CommonFrame:
        """Return the common frame of the registration under a key, without corrections."""
        return CommonFrame(self.registration(key), self.origin)

    def registration(self, key: str) -> Registration:
        """Return the registration under a key."""
        return self.runner.load(PairRegistration, key).registration

    def number(self) -> None:
        """Give the objects of both epochs numbers over their tiles."""
        params = MergingParams("instance" in self.given)
        inputs = [{f"prepared/{n}": k for n, k in self.prepared[epoch].items()} for epoch in EPOCHS]
        stages = [[Task("objects", WHOLE, unite, own, params)] for own in inputs]
        found = self.runner.together(stages, (0.47, 0.48))
        self.united = {epoch: keys[WHOLE] for epoch, keys in zip(EPOCHS, found, strict=True)}

    def _semantics(self, side: EpochContext) -> list[Task[SegmentationParams]]:
        """Tasks of one epoch; they do not tell whether it is *before* or *after*, and serve as both."""
        config = slice_of(SegmentationSlice, self.config)
        tiles, own = self.config.tiles, self.clouds[side.epoch]
        alone = replace(side, epoch=ALONE)
        upright = self._upright(alone, own)
        tasks = []
        for name in sorted(own):
            params = SegmentationParams(name, self.size, tiles.overlap, tiles.edge, alone, config, self.given)
            inputs = {f"cloud/{n}": own[n] for n in (name, *neighbours(name, own))} | upright
            box = corners_around(name, self.size, tiles.overlap + SIGHT)
            beams = self.beams_at(side, box) if side.kind == "observed" else {}
            inputs |= {alias.replace(side.epoch, ALONE, 1): key for alias, key in beams.items()}
            trails = self.trails[side.epoch]
            inputs |= {f"trails/{n}": trails[n] for n in (name, *neighbours(name, own)) if n in trails}
            if f"path/{side.epoch}" in self.paths:
                inputs["path"] = self.paths[f"path/{side.epoch}"]
            if f"places/{side.epoch}" in self.places:
                inputs["places"] = self.places[f"places/{side.epoch}"]
            tasks.append(Task("semantics", name, prepare_tile, inputs, params))
        return tasks

    def _upright(self, side: EpochContext, own: Mapping[str, str]) -> dict[str, str]:
        """Find what makes a local cloud upright."""
        if side.crs is not None:
            return {}
        clouds = {f"cloud/{n}": k for n, k in own.items()}
        task = Task("levelling", WHOLE, find_upright, clouds, LevellingParams(side))
        return {"levelling": self.runner.one(task, (0.05, 0.05))}

    def recut(self, registration: str) -> None:
        """Cut the labelled points of both epochs by the tiles of the common frame."""
        frame = self.common(registration)
        tasks = []
        for side in self.sides:
            own, prepared = self.clouds[side.epoch], self.prepared[side.epoch]
            for tile, names in sorted(self._reached(side, frame).items()):
                inputs = {f"cloud/{n}": own[n] for n in names} | {f"prepared/{n}": prepared[n] for n in names}
                inputs |= {"united": self.united[side.epoch], "registration": registration}
                params = EpochTileParams(tile, self.size, side, self.origin)
                tasks.append(Task("retiling", f"{side.epoch}_{tile}", recut_tile, inputs, params))
        keys = self.runner.run(tasks, (0.48, 0.5))
        for epoch in EPOCHS:
            found = {n.removeprefix(f"{epoch}_"): k for n, k in keys.items() if n.startswith(f"{epoch}_")}
            pieces = {n: self.runner.load(LabelledPoints, k) for n, k in found.items()}
            held = [n for n, piece in pieces.items() if len(piece.semantic)]
            self.points[epoch] = {n: found[n] for n in held}
            self.lit[epoch] = all(pieces[n].intensity is not None for n in held)

    def _reached(self, side: EpochContext, frame: CommonFrame) -> dict[str, list[str]]:
        """Tiles of the common frame that an epoch's own tiles reach into, and which of these."""
        own = self.clouds[side.epoch]
        if side.epoch == "after":
            return {name: [name] for name in own}
        reached: dict[str, list[str]] = {}
        for name in sorted(own):
            xyz = self._cloud(side.epoch, name).xyz
            box = corners(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), xyz[:, 2].min(), xyz[:, 2].max())
            moved = in_frame(box, side, frame).world()[:, :2]
            for tile in tiles_between(moved.min(axis=0), moved.max(axis=0), self.size):
                reached.setdefault(tile, []).append(name)
        return reached

    def beams_at(self, side: EpochContext, world: Floats) -> dict[str, str]:
        """Tiles of beams, or of poses that look there, of an epoch around places (N, 3) of its world."""
        known = self.beams[side.epoch]
        if not known:
            return {}
        if side.beams_crs is not None:
            world = transformer(str(side.crs), side.beams_crs).apply(world)
        edge = self.beam_edge[side.epoch]
        reach = (
            0.0 if side.view is None else min(side.view.useful_range, self.config.evidence.poses.max_range)
        )
        low, high = world[:, :2].min(axis=0) - reach, world[:, :2].max(axis=0) + reach
        near = tiles_between(low, high, edge)
        return {f"beams/{side.epoch}/{n}": known[n] for n in near if n in known}

    def _cloud(self, epoch: str, tile: str) -> TilePoints:
        """Return the points of an epoch in one of its own tiles."""
        return self.runner.load(TilePoints, self.clouds[epoch][tile])


def corners_around(name: str, size: float, rim: float) -> Floats:
    """Return the corners (8, 3) of a tile and its surroundings in the world [m]."""
    box = tile_named(name, size, rim).buffered
    return corners(np.array(box[:2]), np.array(box[2:]))


def _named(name: str, epoch: Epoch, kind: str) -> str:
    """Return *before* or *after* with the file of an epoch, where it was read from one."""
    file = getattr(getattr(epoch, "epoch", epoch), kind, None)
    return f"{name}: {file}" if isinstance(file, Path) else name


def _refuse_no_survey(who: str, crs: str | None, cut: CutCloud, least: int) -> None:
    """Refuse points that are all at one place, and coordinates in degrees, of which few voxels are left."""
    if np.array_equal(cut.low, cut.high):
        raise InputError(
            f"{who}: all {cut.points} points are at one place; check the cloud, or export it again"
        )
    span, largest = cut.high - cut.low, np.maximum(np.abs(cut.low), np.abs(cut.high))
    if crs is None and cut.kept < least and span[:2].max() < 1.0 and largest[0] <= 180 and largest[1] <= 90:
        raise InputError(
            f"{who}: the coordinates look like degrees (x {cut.low[0]:.5f} to {cut.high[0]:.5f}, "
            f"y {cut.low[1]:.5f} to {cut.high[1]:.5f}) and the file names no CRS; reproject it to metres"
        )


def _feet_hint(before: tuple[Floats, Floats], after: tuple[Floats, Floats]) -> str:
    """Return what extents, low and high (3,), say that differ in plan as metres and feet do; else nothing."""
    first, second = ((high - low)[:2] for low, high in (before, after))
    ratio = first / np.maximum(second, 1e-9)
    for name, factor in (("before", ratio), ("after", 1.0 / np.maximum(ratio, 1e-9))):
        if np.all(np.abs(factor * foot - 1.0) < 0.05):
            return f"; the extent of {name} is {factor.mean():.2f} times as large: it may be in feet"
    return ""


def _refuse_elsewhere(who: str, way: Trajectory, cut: CutCloud, reach: float) -> None:
    """Refuse poses that are all farther from the extent of a cloud, in plan, than a surface is seen [m]."""
    nearest = float(distance_to_box(way.positions[:, :2], cut.low[:2], cut.high[:2]).min(initial=np.inf))
    if nearest > reach:
        raise InputError(
            f"{who}: no pose of the trajectory lies within {reach:.0f} m of the cloud (the nearest is "
            f"{nearest:.0f} m away); give the trajectory of this cloud"
        )

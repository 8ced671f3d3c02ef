"""Stages before the segmentation of an epoch: its vertical direction, ghost trails, expected visibility.

The vertical direction of an epoch without CRS follows from the ground of all its tiles. In a cloud without
counts and times of beams, ghost trails are detected by shape. Expected visibility is rendered around the
poses of an epoch tile by tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.level_of_detection.common_frame import upright_turn
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.segmentation.classes import SemanticsConfig
from subiaco_change.segmentation.ghost_trails import trail_probability
from subiaco_change.segmentation.ground_model import fit_ground
from subiaco_change.segmentation.raised_surfaces import find_raised
from subiaco_change.survey_places import GroundDensity, ground_density
from subiaco_change.tiling.epoch_tiles import EpochContext, TilePoints, load_beams
from subiaco_change.view_from_above import ColumnCounts, count_columns
from subiaco_change.visibility_evidence import (
    EvidenceConfig,
    EvidenceKind,
    Observer,
    make_observer,
    poses_observer,
)
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.crs import transformer
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.depth_images import DepthImages
from subiaco_geo.free_space.expected_visibility import (
    ExpectedVisibility,
    ExpectedVisibilityConfig,
    OccupiedVoxels,
    image_grid,
    render_views,
)
from subiaco_geo.free_space.sensor_view import spin_axes
from subiaco_geo.free_space.view_estimation import ViewHistogram, estimate_view, view_histogram
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.tasks import Inputs


@dataclass(frozen=True)
class LevellingParams:
    """The epoch whose ``cloud/<tile>`` are levelled."""

    side: EpochContext


@dataclass(frozen=True)
class Levelling:
    """Rotation (3, 3) that makes the streets of an epoch lie level, None where they do."""

    turn: Floats | None


def find_upright(inputs: Inputs, params: LevellingParams) -> Levelling:
    """Find the rotation that makes the streets of an epoch lie level."""
    thin = [
        voxel_downsample(PointCloud(inputs.of(TilePoints, f"cloud/{name}").xyz), 1.0).xyz
        for name in inputs.under("cloud")
    ]
    return Levelling(upright_turn(PointCloud(np.concatenate(thin), params.side.origin)))


def load_turn(inputs: Inputs) -> Floats | None:
    """Return the rotation of ``levelling``, None where the task rests on none or nothing is turned."""
    found = inputs.find(Levelling, "levelling")
    return None if found is None else found.turn


_SURROUNDINGS = NUMBERS.tiling.trail_surroundings


@dataclass(frozen=True)
class TrailParams:
    """Parameters of the search for ghost trails; the lengths of ``semantics`` are those for this epoch."""

    tile: str
    size: float
    side: EpochContext
    semantics: SemanticsConfig
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class TileTrails:
    """Probability (N,) that each point of a tile, in their order, was left by a moving object.

    ``columns`` counts what its columns hold, which tells a view from above, and ``ground`` the points on its
    ground, which tell where the sensor was.
    """

    moved: NDArray[np.float32]
    columns: ColumnCounts
    ground: GroundDensity


@obeys_rules
def find_trails(inputs: Inputs, params: TrailParams) -> TileTrails:
    """Find how probable it is that the points of a tile were left by a moving vehicle, by their shape.

    A cloud that mapping made may carry what the times of the beams said; the larger probability counts.
    ``inputs`` hold ``cloud/<tile>`` of the tile and its neighbours, and ``levelling`` for local clouds.
    """
    side, config = params.side, params.semantics
    tile = tile_named(params.tile, params.size, _SURROUNDINGS)
    points = inputs.of(TilePoints, f"cloud/{params.tile}")
    own = points.xyz
    others = [
        inputs.of(TilePoints, f"cloud/{name}").xyz for name in inputs.under("cloud") if name != params.tile
    ]
    xyz = np.concatenate([own, *(part[tile.in_buffered(part[:, :2] + side.origin[:2])] for part in others)])
    turn = load_turn(inputs)
    if turn is not None:
        xyz = xyz @ turn.T
    ground = fit_ground(xyz, config.ground, find_raised(xyz, config.raised))
    height = xyz[:, 2] - ground.height(xyz[:, :2])
    moved = trail_probability(xyz, height, config.trail_shape)
    probability = with_times(moved[: len(own)], points.moving).astype(np.float32)
    count = np.ones(len(own), np.int64) if points.count is None else points.count.astype(np.int64)
    density = ground_density(own + side.origin, height[: len(own)], count)
    return TileTrails(probability, count_columns(xyz[: len(own)], side.spacing), density)


def with_times(by_shape: Floats, by_times: NDArray[Any] | None) -> Floats:
    """Return the larger of two probabilities (N,) of having moved: by shape, and by the times of beams.

    ``by_times`` is None, or NaN at a point, where the times of the beams are not known.
    """
    if by_times is None:
        return by_shape
    return np.fmax(by_shape, np.asarray(by_times, dtype=np.float64))


def load_moved(inputs: Inputs, tile: str, names: Sequence[str], where: Sequence[Ints]) -> Floats | None:
    """Put together what :func:`find_trails` left of a tile and of places of its neighbours, if anything."""
    if not inputs.under("trails"):
        return None
    parts = [inputs.of(TileTrails, f"trails/{tile}").moved]
    parts += [
        inputs.of(TileTrails, f"trails/{name}").moved[index] for name, index in zip(names, where, strict=True)
    ]
    return np.concatenate(parts).astype(np.float64)


@dataclass(frozen=True)
class RenderParams:
    """Parameters of the rendering; ``poses`` (K, 4, 4) are those in the tile.

    ``headings`` (K,) are the azimuths that the vehicle faces there [rad]. Points
    hide nothing from a probability of ``moved`` on of having been left by a moving object.
    """

    tile: str
    size: float
    side: EpochContext
    config: ExpectedVisibilityConfig
    poses: Floats
    headings: Floats
    moved: float


@dataclass(frozen=True)
class TileViews:
    """Depth images of the poses in a tile, and what the tile holds.

    ``eyes`` (K, 3), ``axes`` (K, 3), ``headings`` (K,) [rad] and ``images`` (K, rows, columns) of
    :class:`~subiaco_geo.free_space.depth_images.DepthImages`; ``occupied`` (M,), keys of the voxels with
    points.
    """

    eyes: Floats
    axes: Floats
    headings: Floats
    images: NDArray[np.uint16]
    occupied: Ints


def render_tile(inputs: Inputs, params: RenderParams) -> TileViews:
    """Render what the poses in a tile of an epoch must have seen, and what the tile holds.

    ``inputs`` hold ``cloud/<tile>`` as far around as a pose looks, of the tile alone where it has no poses,
    and ``trails/<tile>`` beside them.
    """
    side, config, poses = params.side, params.config, params.poses
    tile = tile_named(params.tile, params.size, config.max_range)
    parts = [_standing(inputs, name, params.moved) for name in inputs.under("cloud")]
    world = np.concatenate([np.zeros((0, 3)), *parts]) + side.origin
    world = world[tile.in_buffered(world[:, :2])]
    own = world[tile.in_core(world[:, :2])]
    images = render_views(world, poses[:, :3, 3].copy(), spin_axes(poses[:, :3, :3]), config)
    occupied = OccupiedVoxels.of(own, side.corner, config.occupied).keys
    return TileViews(images.eyes, images.axes, params.headings, images.images, occupied)


@dataclass(frozen=True)
class NeedsParams:
    """The tile and the epoch of which :func:`find_needs` asks."""

    tile: str
    side: EpochContext
    config: ExpectedVisibilityConfig
    moved: float


def find_needs(inputs: Inputs, params: NeedsParams) -> ViewHistogram:
    """Count what the points of a tile need of the sensor, by all poses that may have seen them.

    The poses of one tile do not suffice: near its border the pose that measured a point, far away and from a
    lower angle, often is that of another tile. ``inputs`` hold ``cloud/<tile>`` and ``trails/<tile>``, and
    under ``views/`` what :func:`render_tile` left of the tiles around.
    """
    xyz = _standing(inputs, params.tile, params.moved) + params.side.origin
    parts = [inputs.of(TileViews, f"views/{name}") for name in inputs.under("views")]
    eyes, axes, images = (
        np.concatenate(arrays) for arrays in zip(*((p.eyes, p.axes, p.images) for p in parts), strict=True)
    )
    grid = image_grid(params.config)
    return view_histogram(xyz, DepthImages(eyes, axes, images, grid), params.config)


def _standing(inputs: Inputs, name: str, limit: float) -> Floats:
    """Return the points (N, 3) of a tile that no moving object left: a ghost trail hides nothing."""
    xyz = inputs.of(TilePoints, f"cloud/{name}").xyz
    trails = inputs.find(TileTrails, f"trails/{name}")
    return xyz if trails is None else xyz[trails.moved < limit]


def load_expected(
    inputs: Inputs, alias: str, side: EpochContext, config: ExpectedVisibilityConfig
) -> ExpectedVisibility:
    """Put the pieces of :func:`render_tile` under ``alias/`` together."""
    parts = [inputs.of(TileViews, f"{alias}/{name}") for name in inputs.under(alias)]
    view = estimate_view([], config) if side.view is None else side.view
    grid = image_grid(config)
    if not parts:
        none = np.zeros((0, 3))
        images = DepthImages(none, none, np.zeros((0, grid.rows, grid.columns), dtype=np.uint16), grid)
        keys = np.zeros(0, dtype=np.int64)
    else:
        eyes, axes = np.concatenate([p.eyes for p in parts]), np.concatenate([p.axes for p in parts])
        images = DepthImages(eyes, axes, np.concatenate([p.images for p in parts]), grid)
        images = images.blinded(np.concatenate([p.headings for p in parts]), view.blind or ())
        keys = np.unique(np.concatenate([p.occupied for p in parts]))  # on a border, two tiles hold a voxel
    return ExpectedVisibility(images, OccupiedVoxels(keys, side.corner, side.voxel), view, config)


def load_observer(inputs: Inputs, side: EpochContext, points: Floats, config: EvidenceConfig) -> Observer:
    """Build the observer of an epoch around a place.

    Parameters
    ----------
    inputs : Inputs
        Counted beams, or what :func:`render_tile` left, under ``beams/<epoch>/``.
    side : EpochContext
    points : (N, 3) float64
        Points of the epoch around, in its world coordinates: what shadow tests rest on.
    config : EvidenceConfig
    """
    alias = f"beams/{side.epoch}"
    cloud = PointCloud(points - side.origin, side.origin, side.crs)
    if side.kind in ("trajectory", "estimated"):
        expected = load_expected(inputs, alias, side, config.poses)
        return Observer(side.kind, expected) if len(cloud) == 0 else poses_observer(expected, cloud, config)
    kind: EvidenceKind = (
        "observed" if side.kind == "shadow" and len(cloud) == 0 else side.kind
    )  # nothing was seen
    grid = load_beams(inputs, alias, side.corner, side.voxel) if kind == "observed" else None
    asked = config.model_copy(update={"source": kind})
    back = None if side.beams_crs is None else transformer(str(side.crs), side.beams_crs).apply
    found = make_observer(SurveyMap(cloud, visibility=grid), asked, back, from_above=side.from_above)
    return Observer(side.kind, found.test, found.to_own, found.certain)

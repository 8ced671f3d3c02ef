"""Expected visibility (Decision 16): what a survey must have seen, from its poses and its own cloud.

A place is free where poses could have seen it, nothing of the epoch's own cloud is in front of it and no
point in it. Whether a beam came back from behind does not matter: the sky returns nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from subiaco_geo.clouds import packable, unique_cells, unpack_voxel_keys, voxel_indices, voxel_keys
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.depth_images import DepthImages, ImageGrid, Limits, Surfaces, render
from subiaco_geo.free_space.sensor_view import SensorView

Flags = NDArray[np.bool_]


class ExpectedVisibilityConfig(StrictModel):
    """Depth images from a sample of poses (Decision 16)."""

    pose_spacing: float = Field(
        2.0,
        gt=0,
        description="Distance along the trajectory between poses from which depth images are computed [m]",
    )
    cell_deg: float = Field(0.75, gt=0, le=5, description="Angular size of the cells of a depth image [deg]")
    image_low_deg: float = Field(-35.0, ge=-90, description="Lowest elevation angle of a depth image [deg]")
    image_high_deg: float = Field(55.0, le=90, description="Highest elevation angle of a depth image [deg]")
    splat: float = Field(
        0.75,
        gt=0,
        description="Half the size of a point in a depth image, as a multiple of the point spacing",
    )
    level_block: float = Field(
        1.0, gt=0, description="Edge of the blocks in which points decide whether their surface is level [m]"
    )
    level_rise: float = Field(
        0.3, ge=0, description="Largest height range of the points of a level block [m]"
    )
    min_range: float = Field(
        1.5, ge=0, description="Distance from a pose below which points and places are ignored [m]"
    )
    max_range: float = Field(80.0, gt=0, description="Largest distance of a surface in a depth image [m]")
    sky_range: float = Field(
        40.0, gt=0, description="Distance from a pose up to which places against the sky count as free [m]"
    )
    horizon_deg: float = Field(
        3.0,
        description="Elevation angle above which directions without points are sky [deg]; below, water or "
        "glass may absorb beams",
    )
    margin: float = Field(
        0.3,
        ge=0,
        description="Distance in front of a surface at which free space ends [m]; raise it for less "
        "precise poses",
    )
    margin_slope: float = Field(
        0.01,
        ge=0,
        description="Increase of the free space margin per metre of range, for errors of pose and cell "
        "size [m/m]",
    )
    behind: float = Field(
        0.4,
        ge=0,
        description="Distance behind the front of a surface up to which a place is on the surface [m]",
    )
    min_poses: int = Field(2, ge=1, description="Number of poses that must agree that a place is free")
    occupied: float = Field(0.5, gt=0, description="Edge of the voxel that a point of the epoch occupies [m]")
    pose_weight: float = Field(
        0.5, gt=0, description="Number of beams that one pose counts for in the probability of being free"
    )
    view_quantile: float = Field(
        0.998,
        gt=0.5,
        le=1,
        description="Fraction of the points that the estimated field of view must contain",
    )
    assumed_low_deg: float = Field(
        -25.0,
        ge=-90,
        le=0,
        description="Lower end of a field of view that no map describes, because the road from afar does "
        "not show it [deg]",
    )
    view_range: float = Field(
        60.0,
        gt=0,
        description="Distance of the poses by which the upper end of a field of view is estimated [m]; from "
        "farther away all things are low",
    )
    range_quantile: float = Field(
        0.999,
        gt=0.5,
        le=1,
        description="Fraction of the points that lie within the estimated useful range of a pose",
    )


def sample_poses(positions: Floats, spacing: float) -> Ints:
    """Return indices of positions (M, 3), in order, no two of them nearer than about ``spacing`` [m].

    One a stretch of that length; where the way comes by again, places that were kept before stand in.
    """
    if len(positions) == 0:
        return np.zeros(0, dtype=np.int64)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    _, first = np.unique(np.floor(way / spacing), return_index=True)
    return np.asarray(first[places_apart(positions[first], 0.5 * spacing)], dtype=np.int64)


def places_apart(places: Floats, distance: float) -> NDArray[np.bool_]:
    """Tell which places (M, D), in order, are farther than a distance from every one that was kept before."""
    kept = np.ones(len(places), dtype=bool)
    for index, around in enumerate(cKDTree(places).query_ball_point(places, distance)):
        kept[index] = not any(kept[other] for other in around if other < index)
    return kept


def point_spacing(xyz: Floats, sample: int = 4000) -> float:
    """Return the distance between neighbouring points of a surface, of points (N, 3) [m].

    The median distance to the fourth neighbour, of a sample in even steps.
    """
    if len(xyz) < 5:
        return 0.0
    some = xyz[:: max(len(xyz) // sample, 1)]
    return float(np.median(cKDTree(xyz).query(some, k=[5])[0]))


def image_grid(config: ExpectedVisibilityConfig) -> ImageGrid:
    """Return the cells of the images of a configuration."""
    return ImageGrid.covering(config.cell_deg, config.image_low_deg, config.image_high_deg)


def render_views(world: Floats, eyes: Floats, axes: Floats, config: ExpectedVisibilityConfig) -> DepthImages:
    """Render depth images of points (N, 3) from poses at eyes (K, 3) [m, world], spin axes (K, 3)."""
    grid = image_grid(config)
    origin = eyes[0] if len(eyes) else np.zeros(3)
    near = world - origin
    reach = config.max_range
    if len(eyes):
        low, high = (eyes - origin).min(axis=0) - reach, (eyes - origin).max(axis=0) + reach
        near = near[((near >= low) & (near <= high)).all(axis=1)]
    surfaces = Surfaces(
        config.splat * point_spacing(near),
        config.min_range,
        reach,
        float(np.radians(config.horizon_deg)),
        config.level_block,
        config.level_rise,
    )
    return DepthImages(eyes, axes, render(near, eyes - origin, grid, surfaces), grid)


def occupied_corner(low: Floats, config: ExpectedVisibilityConfig) -> Floats:
    """Return the corner (3,) of the occupied voxels below the lowest coordinates (3,) of an epoch [m]."""
    return np.asarray(np.floor(low) - 2.0 * config.occupied)


def occupied_columns(keys: Ints, corner: Floats, voxel: float) -> Floats:
    """Return the centres (M, 2) of the columns of occupied voxels (N,) in the world [m]."""
    columns, _ = unique_cells(unpack_voxel_keys(keys)[:, :2])
    return np.asarray((columns + 0.5) * voxel + corner[:2])


@dataclass(frozen=True)
class OccupiedVoxels:
    """Voxels with points of an epoch: sorted packed keys, corner (3,) in the world and edge [m]."""

    keys: Ints
    corner: Floats
    voxel: float

    @staticmethod
    def of(world: Floats, corner: Floats, voxel: float) -> OccupiedVoxels:
        """Return the voxels of points (N, 3) [m, world]."""
        return OccupiedVoxels(np.unique(voxel_keys(voxel_indices(world - corner, voxel))), corner, voxel)

    def holds(self, world: Floats) -> Flags:
        """Tell which places (N, 3) [m, world] lie in voxels with points."""
        index = voxel_indices(world - self.corner, self.voxel)
        near = packable(index)
        if len(self.keys) == 0 or not near.any():
            return np.zeros(len(index), dtype=np.bool_)
        query = voxel_keys(np.where(near[:, None], index, 0))
        slot = np.minimum(np.searchsorted(self.keys, query), len(self.keys) - 1)
        return np.asarray(near & (self.keys[slot] == query))


@dataclass(frozen=True)
class ExpectedVisibility:
    """Tells of places whether an epoch must have seen them occupied or free.

    Parameters
    ----------
    images : DepthImages
    occupied : OccupiedVoxels
    view : SensorView
    config : ExpectedVisibilityConfig
    """

    images: DepthImages
    occupied: OccupiedVoxels
    view: SensorView
    config: ExpectedVisibilityConfig

    def observed(self, world: Floats) -> Flags:
        """Tell which places (N, 3) [m, world] the epoch saw, free or not."""
        seen = self.occupied.holds(world)
        ask = np.flatnonzero(~seen)
        looks = self.images.looks(world[ask], self._limits(), self.config.min_poses, surface_too=True)
        seen[ask] = (looks.free >= self.config.min_poses) | (looks.surface > 0)
        return seen

    def passed(self, world: Floats) -> Flags:
        """Tell which places (N, 3) [m, world] the epoch saw to be free."""
        free = ~self.occupied.holds(world)
        ask = np.flatnonzero(free)
        looks = self.images.looks(world[ask], self._limits(), self.config.min_poses)
        free[ask] = looks.free >= self.config.min_poses
        return free

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that places (N, 3) [m, world] are free; 0.5 where nothing is known.

        Poses count as independent looks of ``pose_weight`` beams, under a uniform-like prior of half a
        beam each way; a point of the epoch in the place counts as one beam that ended there. Poses that meet
        a surface at a place without a point know nothing of it: images are coarser than the cloud, and what
        lies behind the front of a crown or a wall is not known to be occupied.
        """
        return self.free_and_undecided(world)[0]

    def free_and_undecided(self, world: Floats) -> tuple[Floats, Flags]:
        """Return :meth:`free_probability` (N,) of places (N, 3), and which the poses have in view undecided.

        The latter lie at a surface of the epoch, in the margin in front of it, or behind it, and hold no
        point.
        """
        looks = self.images.looks(world, self._limits())
        weight = self.config.pose_weight
        held = self.occupied.holds(world)
        free, met = weight * looks.free, (weight * looks.surface + 1.0) * held
        few = looks.free < self.config.min_poses
        free[few] = 0.0
        in_view = (looks.surface > 0) | (looks.hidden >= self.config.min_poses)
        return np.asarray((free + 0.5) / (free + met + 1.0)), np.asarray(in_view & few & ~held)

    def hidden(self, world: Floats) -> Flags:
        """Tell which places (N, 3) [m, world] lie in view of enough poses, but behind a surface for each.

        Of these the poses say nothing. Foliage lets beams by that a closed depth image does not.
        """
        return np.asarray(self.behind_surfaces(world) & ~self.occupied.holds(world))

    def behind_surfaces(self, world: Floats) -> Flags:
        """Tell which places (N, 3) [m, world], with points or without, lie behind a surface for all poses.

        A point there shows that beams went through or past that surface: a hedge, a fence, a gap between
        two poses.
        """
        looks = self.images.looks(world, self._limits())
        nothing = (looks.free < self.config.min_poses) & (looks.surface == 0)
        return np.asarray(nothing & (looks.hidden >= self.config.min_poses))

    def exposure(self, world: Floats) -> Floats:
        """Return how many beams the poses send places (N, 3) [m, world], up to a factor; hidden or not."""
        return self.images.exposure(world, self._limits())

    def _limits(self) -> Limits:
        config, view = self.config, self.view
        reach = min(view.useful_range, config.max_range)
        return Limits(
            float(np.sin(view.elevation_min)),
            float(np.sin(view.elevation_max)),
            config.min_range,
            reach,
            min(reach, config.sky_range),
            config.margin,
            config.margin_slope,
            config.behind,
        )

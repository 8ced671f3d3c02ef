"""Spherical depth images of a point cloud around poses, and what they tell of places."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.azimuth_sector import Arcs, in_arcs
from subiaco_geo.free_space.numbers import FREE_SPACE

#: Depth [cm] of directions about which nothing is known, and of empty ones against the sky.
UNKNOWN, SKY = 0, 65535
_FARTHEST = 65000.0  # depth that an image holds [cm]

Depths = NDArray[np.uint16]


@dataclass(frozen=True)
class ImageGrid:
    """Cells of a depth image: levelled axes, azimuth from -180 deg, rows upward.

    Parameters
    ----------
    cell : float
        Edge [rad]; a whole number of cells goes around.
    low : float
        Elevation of the lower edge of the lowest row [rad].
    rows : int
    """

    cell: float
    low: float
    rows: int

    @property
    def columns(self) -> int:
        """Cells around."""
        return round(2.0 * np.pi / self.cell)

    @staticmethod
    def covering(cell_deg: float, low_deg: float, high_deg: float) -> ImageGrid:
        """Return the grid of about this cell that covers these elevations."""
        columns = max(round(360.0 / cell_deg), 8)
        cell = 2.0 * np.pi / columns
        rows = int(np.ceil(np.radians(high_deg - low_deg) / cell - 1e-9))
        return ImageGrid(cell, float(np.radians(low_deg)), rows)


@dataclass(frozen=True)
class Surfaces:
    """How points become surfaces in an image.

    Parameters
    ----------
    splat : float
        Half the size of a point [m]: near surfaces are closed by it.
    nearest, farthest : float
        Points nearer to a pose are the vehicle's own, farther ones are left out [m].
    horizon : float
        Empty directions above this elevation are sky; below, something may have absorbed the beam [rad].
    block, rise : float
        Points lie level where those of a block of this edge are within this rise [m].
    """

    splat: float
    nearest: float
    farthest: float
    horizon: float
    block: float = 1.0
    rise: float = 0.3


@numba.njit(cache=True, inline="always")
def _arctan2(y: float, x: float) -> float:
    """Angle to 1e-5 rad, a quarter of the time of the exact one."""
    ax, ay = abs(x), abs(y)
    if ax == 0.0 and ay == 0.0:
        return 0.0
    small, large = (ay, ax) if ay < ax else (ax, ay)
    q = small / large
    s = q * q
    angle = q * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))))
    if ay > ax:
        angle = 0.5 * np.pi - angle
    if x < 0.0:
        angle = np.pi - angle
    return angle if y >= 0.0 else -angle


@numba.njit(cache=True)
def _splat(
    xyz: Floats, level: NDArray[np.bool_], eye: Floats, cell: float, low: float, depth: NDArray[np.float32],
    splat: float, nearest: float, farthest: float, thickness: float, cosine: float,
) -> None:  # fmt: skip
    """Write the nearest depth [m] of every cell that a point covers; points of level surfaces lie flat."""
    rows, columns = depth.shape
    for i in range(len(xyz)):
        dx, dy, dz = xyz[i, 0] - eye[0], xyz[i, 1] - eye[1], xyz[i, 2] - eye[2]
        flat2 = dx * dx + dy * dy
        r2 = flat2 + dz * dz
        if r2 > farthest * farthest or r2 < nearest * nearest:
            continue
        r, flat = np.sqrt(r2), np.sqrt(flat2)
        elevation = (_arctan2(dz, flat) - low) / cell
        half = splat / r / cell
        tall = max(half * abs(dz) / r, half * thickness) if level[i] else half
        first, last = int(np.floor(elevation - tall)), int(np.floor(elevation + tall))
        if last < 0 or first >= rows:
            continue
        azimuth = (_arctan2(dy, dx) + np.pi) / cell
        wide = min(half / max(flat / r, cosine), 0.5 * columns - 1.0)
        left, right = int(np.floor(azimuth - wide)), int(np.floor(azimuth + wide))
        near = np.float32(r)
        for row in range(max(first, 0), min(last, rows - 1) + 1):
            for column in range(left, right + 1):
                at = column % columns
                depth[row, at] = min(depth[row, at], near)


@numba.njit(cache=True)
def _closed(depth: NDArray[np.float32], sky_row: int) -> Depths:
    """Turn depths [m] to centimetres; empty cells take the nearest depth around, are sky, or unknown."""
    rows, columns = depth.shape
    image = np.zeros((rows, columns), dtype=np.uint16)
    for row in range(rows):
        for column in range(columns):
            near = depth[row, column]
            if near == np.inf:
                for r in range(max(row - 1, 0), min(row + 2, rows)):
                    for c in range(column - 1, column + 2):
                        near = min(near, depth[r, c % columns])
            if near == np.inf:
                image[row, column] = SKY if row >= sky_row else UNKNOWN
            else:
                image[row, column] = np.uint16(max(min(near * 100.0, _FARTHEST), 1.0))
    return image


def level_points(xyz: Floats, block: float, rise: float) -> NDArray[np.bool_]:
    """Tell which points (N, 3) lie on a level surface: in their block all points are within a rise [m].

    Seen at a grazing angle, the road would stand up as a curb if its points were as tall as they are wide.
    """
    if len(xyz) == 0:
        return np.zeros(0, dtype=np.bool_)
    _, place = np.unique(voxel_keys(voxel_indices(xyz - xyz[0], block)), return_inverse=True)
    span = np.tile([np.inf, -np.inf], (int(place.max()) + 1, 1))
    np.minimum.at(span[:, 0], place, xyz[:, 2])
    np.maximum.at(span[:, 1], place, xyz[:, 2])
    return np.asarray((span[:, 1] - span[:, 0] <= rise)[place])


def render(xyz: Floats, eyes: Floats, grid: ImageGrid, surfaces: Surfaces) -> Depths:
    """Render the depth images of points (N, 3) from eyes (K, 3), one frame [m].

    Returns
    -------
    (K, rows, columns) uint16
        Range of the nearest surface of every cell [cm], :data:`SKY` or :data:`UNKNOWN`.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float64)
    level = level_points(points, surfaces.block, surfaces.rise)
    images = np.zeros((len(eyes), grid.rows, grid.columns), dtype=np.uint16)
    sky_row = int(np.ceil((surfaces.horizon - grid.low) / grid.cell))
    for number, eye in enumerate(np.ascontiguousarray(eyes, dtype=np.float64)):
        depth = np.full((grid.rows, grid.columns), np.inf, dtype=np.float32)
        _splat(
            points,
            level,
            eye,
            grid.cell,
            grid.low,
            depth,
            surfaces.splat,
            surfaces.nearest,
            surfaces.farthest,
            FREE_SPACE.level_thickness,
            FREE_SPACE.widest_cosine,
        )
        images[number] = _closed(depth, sky_row)
    return images


@dataclass(frozen=True)
class PoseCounts:
    """From how many poses a place (N,) was seen free, met as a surface, or hidden, int32 each."""

    free: NDArray[np.int32]
    surface: NDArray[np.int32]
    hidden: NDArray[np.int32]


@dataclass(frozen=True)
class Limits:
    """When a pose sees a place.

    Parameters
    ----------
    sine_min, sine_max : float
        Sines of the lowest and highest elevation in the sensor's own axes.
    nearest, farthest, sky : float
        Range from which on, up to which, and up to which against the sky, a place is seen [m].
    margin, margin_slope : float
        A place is free so far before a surface: [m], and [m] a metre of range.
    behind : float
        So far behind the front of a surface a place still is on it [m].
    """

    sine_min: float
    sine_max: float
    nearest: float
    farthest: float
    sky: float
    margin: float
    margin_slope: float
    behind: float

    def packed(self) -> Floats:
        """Return the numbers as an array for the kernels."""
        seen = (self.sine_min, self.sine_max, self.nearest, self.farthest, self.sky)
        return np.array([*seen, self.margin, self.margin_slope, self.behind])


@numba.njit(cache=True)
def _look(  # noqa: C901, PLR0912
    places: Floats, eyes: Floats, axes: Floats, poses: Ints, images: Depths,
    cell: float, low: float, limits: Floats, enough: int, surface_too: bool, counts: NDArray[np.int32],
) -> None:  # fmt: skip
    """Count the verdicts of poses on places; with ``enough`` above 0 stop where the answer is decided.

    Decided: enough poses saw it free, or, with ``surface_too``, one met a surface.
    """
    _, rows, columns = images.shape
    sine_min, sine_max, nearest, farthest, sky = limits[:5]
    margin, slope, behind = limits[5:]
    for i in range(len(places)):
        free, surface, hidden = 0, 0, 0
        for k in poses:
            dx, dy, dz = places[i, 0] - eyes[k, 0], places[i, 1] - eyes[k, 1], places[i, 2] - eyes[k, 2]
            flat2 = dx * dx + dy * dy
            r2 = flat2 + dz * dz
            if r2 > farthest * farthest or r2 < nearest * nearest:
                continue
            r = np.sqrt(r2)
            sine = (dx * axes[k, 0] + dy * axes[k, 1] + dz * axes[k, 2]) / r
            if sine < sine_min or sine > sine_max:
                continue
            row = int(np.floor((_arctan2(dz, np.sqrt(flat2)) - low) / cell))
            if row < 0 or row >= rows:
                continue
            column = int(np.floor((_arctan2(dy, dx) + np.pi) / cell)) % columns
            depth = images[k, row, column]
            if depth == UNKNOWN:
                continue
            if depth == SKY:
                free += 1 if r <= sky else 0
            elif r < 0.01 * depth - margin - slope * r:
                free += 1
            elif r <= 0.01 * depth + behind:
                surface += 1
            else:
                hidden += 1
            if enough > 0 and (free >= enough or (surface_too and surface > 0)):
                break
        counts[i, 0], counts[i, 1], counts[i, 2] = free, surface, hidden


@numba.njit(cache=True)
def _exposure(
    places: Floats, eyes: Floats, axes: Floats, poses: Ints, limits: Floats, exposure: Floats
) -> None:
    """Add up what poses that have a place in their field of view and range send it, hidden or not."""
    sine_min, sine_max, nearest, farthest = limits[:4]
    for i in range(len(places)):
        for k in poses:
            dx, dy, dz = places[i, 0] - eyes[k, 0], places[i, 1] - eyes[k, 1], places[i, 2] - eyes[k, 2]
            r2 = dx * dx + dy * dy + dz * dz
            if r2 > farthest * farthest or r2 < nearest * nearest:
                continue
            sine = (dx * axes[k, 0] + dy * axes[k, 1] + dz * axes[k, 2]) / np.sqrt(r2)
            if sine_min <= sine <= sine_max:
                exposure[i] += 1.0 / r2


@numba.njit(cache=True)
def _hides(
    places: Floats, eyes: Floats, images: Depths, cell: float, low: float,
    place: NDArray[np.int32], image: Ints, behind: float, hidden: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Tell which lines of sight end at a surface before their place."""
    _, rows, columns = images.shape
    for line in range(len(place)):
        k, i = image[line], place[line]
        if k < 0:
            continue
        dx, dy, dz = places[i, 0] - eyes[k, 0], places[i, 1] - eyes[k, 1], places[i, 2] - eyes[k, 2]
        flat2 = dx * dx + dy * dy
        row = int(np.floor((_arctan2(dz, np.sqrt(flat2)) - low) / cell))
        if row < 0 or row >= rows:
            continue
        depth = images[k, row, int(np.floor((_arctan2(dy, dx) + np.pi) / cell)) % columns]
        if depth not in (UNKNOWN, SKY):
            hidden[line] = np.sqrt(flat2 + dz * dz) > 0.01 * depth + behind


@dataclass(frozen=True)
class DepthImages:
    """Depth images of an epoch's own cloud from a sample of its poses.

    Parameters
    ----------
    eyes, axes : (K, 3) float64
        Positions in the world [m], and the sensor's spin axis there.
    images : (K, rows, columns) uint16
        See :func:`render`.
    grid : ImageGrid
    """

    eyes: Floats
    axes: Floats
    images: Depths
    grid: ImageGrid

    def blinded(self, headings: Floats, blind: Arcs) -> DepthImages:
        """Return images that know nothing of blind arcs about the headings (K,) of the vehicle [rad]."""
        if not blind:
            return self
        centres = (np.arange(self.grid.columns) + 0.5) * self.grid.cell - np.pi
        closed = in_arcs(centres[None] - headings[:, None], blind)
        return replace(self, images=np.where(closed[:, None], np.uint16(UNKNOWN), self.images))

    def looks(
        self, world: Floats, limits: Limits, enough: int = 0, *, surface_too: bool = False
    ) -> PoseCounts:
        """Count from how many poses places (N, 3) of the world were seen free, as a surface, or hidden.

        Parameters
        ----------
        enough : int
            Stop at so many free poses; 0 asks all poses.
        surface_too : bool
            Stop at the first surface as well.
        """
        counts = np.zeros((len(world), 3), dtype=np.int32)
        if len(world) and len(self.eyes):
            near, origin = self._near(world, limits), self.eyes[0]
            _look(
                np.ascontiguousarray(world - origin), self.eyes - origin, np.ascontiguousarray(self.axes),
                near, self.images, self.grid.cell, self.grid.low, limits.packed(), enough, surface_too,
                counts,
            )  # fmt: skip
        return PoseCounts(counts[:, 0].copy(), counts[:, 1].copy(), counts[:, 2].copy())

    def exposure(self, world: Floats, limits: Limits) -> Floats:
        """Return how many beams the poses send places (N, 3) of the world, up to a factor; hidden or not.

        Each pose that has the place in its field of view and range counts as the inverse square of its
        distance [1/m2].
        """
        exposure = np.zeros(len(world))
        if len(world) and len(self.eyes):
            near, origin = self._near(world, limits), self.eyes[0]
            _exposure(
                np.ascontiguousarray(world - origin), self.eyes - origin, np.ascontiguousarray(self.axes),
                near, limits.packed(), exposure,
            )  # fmt: skip
        return exposure

    def _near(self, world: Floats, limits: Limits) -> Ints:
        """Return which poses may see any of some places (N, 3)."""
        low, high = world.min(axis=0) - limits.farthest, world.max(axis=0) + limits.farthest
        return np.flatnonzero(((self.eyes >= low) & (self.eyes <= high)).all(axis=1))

    def hides(self, world: Floats, place: NDArray[np.int32], image: Ints, behind: float) -> NDArray[np.bool_]:
        """Tell which lines of sight (L,) end at a surface of their image before they reach their place.

        Parameters
        ----------
        world : (N, 3) float64
            Places [m].
        place, image : (L,) int
            Which place a line leads to, and from which of the images; none where negative.
        behind : float
            So far behind the front of a surface a place still is on it [m].
        """
        hidden = np.zeros(len(place), dtype=np.bool_)
        if len(self.eyes):
            origin = self.eyes[0]
            _hides(
                np.ascontiguousarray(world - origin), self.eyes - origin, self.images, self.grid.cell,
                self.grid.low, place, image, behind, hidden,
            )  # fmt: skip
        return hidden

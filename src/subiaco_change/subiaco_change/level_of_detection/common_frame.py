"""Common frame of both epochs: one origin, axes of *after*, smooth corrections, and the way back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from subiaco_change.geometry import Level, fit_planes
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.records import Registration
from subiaco_change.registration.coarse import levelling
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.frames import Floats, Ints, invert_pose, transform_points

_UPRIGHT_DEG = NUMBERS.common_frame.upright_deg


@dataclass(frozen=True)
class BlockGrid:
    """Square blocks in the common frame: south-west corner (2,) [m], edge [m], rows (north) and columns."""

    corner: Floats
    cell: float
    shape: tuple[int, int]

    def block_of(self, xy: Floats) -> Ints:
        """Return the flat index (N,) of the block that holds, or lies nearest to, points (N, 2 or 3)."""
        index = np.floor((xy[:, :2] - self.corner) / self.cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape[::-1]) - 1)
        return np.asarray(index[:, 1] * self.shape[1] + index[:, 0])

    def nodes(self, xy: Floats) -> Floats:
        """Return positions (2, N) in rows and columns; whole numbers are the centres of blocks."""
        return ((xy[:, :2] - self.corner) / self.cell - 0.5)[:, ::-1].T

    def centres(self) -> Floats:
        """Return the centres (rows * columns, 2) of the blocks [m]."""
        row, column = np.divmod(np.arange(self.shape[0] * self.shape[1]), self.shape[1])
        return self.corner + (np.column_stack([column, row]) + 0.5) * self.cell


@dataclass(frozen=True)
class SmoothField:
    """A displacement [m] for every place: ``values`` (rows, columns, 3) at the centres of blocks."""

    grid: BlockGrid
    values: Floats

    def at(self, xyz: Floats) -> Floats:
        """Return the displacement (N, 3) at points (N, 3), bilinear, constant beyond the outer centres."""
        where = self.grid.nodes(xyz)
        parts = [
            ndimage.map_coordinates(self.values[:, :, k], where, order=1, mode="nearest") for k in range(3)
        ]
        return np.stack(parts, axis=1)


@dataclass(frozen=True)
class CommonFrame:
    """The local frame of *after*: its world coordinates minus ``origin`` [m].

    ``corrections`` move *before* after the rigid transform, one upon the
    other. They serve the comparison; ``T_after_before`` stays rigid.
    """

    registration: Registration
    origin: Floats
    corrections: tuple[SmoothField, ...] = ()

    def corrected(self, correction: SmoothField | None) -> CommonFrame:
        """Return the frame with one more correction, if there is one."""
        if correction is None:
            return self
        return replace(self, corrections=(*self.corrections, correction))

    @property
    def T_frame_before(self) -> Floats:
        """Rigid 4x4 from world coordinates of *before* to the frame."""
        T = self.registration.T_after_before.copy()
        T[:3, 3] -= self.origin
        return T

    def bring(self, before: PointCloud) -> PointCloud:
        """Move *before* into the frame, its CRS becoming that of *after*; normals turn with it."""
        r = self.registration
        centred = before.xyz + (before.origin - r.origin)
        xyz = transform_points(r.T_local, centred) + (r.origin - self.origin)
        for correction in self.corrections:
            xyz = xyz + correction.at(xyz)
        fields = dict(before.fields)
        if "normals" in fields:
            fields["normals"] = np.asarray(fields["normals"], dtype=np.float64) @ r.T_local[:3, :3].T
        return PointCloud(xyz, self.origin, before.crs, fields)

    def before_world(self, xyz: Floats) -> Floats:
        """World coordinates that points (N, 3) of the frame have in *before*."""
        r = self.registration
        for correction in reversed(self.corrections):
            # so smooth a field differs by micrometres between a place and where it came from
            xyz = xyz - correction.at(xyz)
        return transform_points(invert_pose(r.T_local), xyz + (self.origin - r.origin)) + r.origin

    def after_world(self, xyz: Floats) -> Floats:
        """World coordinates of points (N, 3) of the frame in *after*."""
        return xyz + self.origin


def levelled(cloud: PointCloud) -> PointCloud:
    """Turn a local cloud so that its streets lie level on the whole; one with a CRS is upright already.

    For labelling alone: nothing turned is handed on, else a mean slope would tilt the city.
    """
    turn = upright_turn(cloud)
    if turn is None:
        return cloud
    fields = dict(cloud.fields)
    if "normals" in fields:
        fields["normals"] = np.asarray(fields["normals"], dtype=np.float64) @ turn.T
    return PointCloud(cloud.xyz @ turn.T, cloud.origin, None, fields)


def upright_turn(cloud: PointCloud) -> Floats | None:
    """Rotation (3, 3) that makes the streets of a local cloud lie level; None where they do."""
    if cloud.crs is not None or len(cloud) == 0:
        return None
    points = voxel_downsample(PointCloud(cloud.xyz), 1.0).xyz
    turn = levelling(Level(1.0, points, fit_planes(points, 2.5)))[:3, :3]
    return None if turn[2, 2] > np.cos(np.radians(_UPRIGHT_DEG)) else np.asarray(turn)


def seen_through(
    observed: Callable[[Floats], Mask], to_world: Callable[[Floats], Floats]
) -> Callable[[Floats], Mask]:
    """Ask an epoch whether it observed points given in the common frame."""
    return lambda xyz: observed(to_world(xyz)) if len(xyz) else np.zeros(0, dtype=bool)


def free_through(
    probability: Callable[[Floats], Floats], to_world: Callable[[Floats], Floats]
) -> Callable[[Floats], Floats]:
    """Ask an epoch how probable it is that points given in the common frame are free."""
    return lambda xyz: probability(to_world(xyz)) if len(xyz) else np.zeros(0)

"""Alignment without priors: level by the ground, then match structure seen from above.

Both clouds are levelled by the commonest near-vertical normal. What is left,
yaw and a shift, is searched by correlating bird's-eye pictures of everything
that stands (walls, trunks, crowns) over all yaws with the FFT; heights follow
from the ground. Every candidate is refined by NDT and judged in 3D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from subiaco_change.geometry import Level, LocalPlanes
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.frames import Floats, make_pose, transform_points

_STANDING = NUMBERS.coarse.wall_normal


def up_direction(planes: LocalPlanes, widest_deg: float = 30.0) -> Floats:
    """Find the commonest normal near e_z by mean shift with a shrinking kernel.

    Undulating ground, roofs and crowns spread around or away from it; it
    stands for the mean vertical of the streets.
    """
    normals = planes.normals[planes.curvature < 0.04]
    up = np.array([0.0, 0.0, 1.0])
    for width in (widest_deg, 15.0, 8.0, 5.0, 5.0, 5.0):
        cosine = normals @ up
        weight = np.where(cosine > np.cos(np.radians(width)), 1.0, 0.0)
        if weight.sum() < 10:
            break
        up = weight @ normals
        up /= np.linalg.norm(up)
    return up


def levelling(level: Level) -> Floats:
    """Rotation (4, 4) about zero that turns the up direction of a cloud onto e_z."""
    up = up_direction(level.planes)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(4)
    angle = np.arctan2(sine, up[2])
    return make_pose(Rotation.from_rotvec(axis / sine * angle).as_matrix(), np.zeros(3))


def _picture(xy: Floats, corner: Floats, pixel: float, size: int) -> Floats:
    """Density (size, size) of standing points, in pixels [m]."""
    ij = np.floor((xy - corner) / pixel).astype(np.int64)
    keep = np.all((ij >= 0) & (ij < size), axis=1)
    flat = np.bincount(ij[keep, 0] * size + ij[keep, 1], minlength=size * size)
    return np.log1p(flat.reshape(size, size).astype(np.float32))


def _band(size: int, fine: float = 0.8, broad: float = 5.0) -> Floats:
    """Spectrum (size, size // 2 + 1) of a difference of Gaussians of two widths [pixels]."""
    squared = fft.fftfreq(size)[:, None] ** 2 + fft.rfftfreq(size)[None] ** 2
    low, high = (np.exp(-2.0 * (np.pi * width) ** 2 * squared) for width in (broad, fine))
    return np.asarray((high - low).astype(np.float32))


@dataclass(frozen=True)
class StartPose:
    """A start pose ``T_after_before`` and the score that proposed it."""

    pose: Floats
    score: float


@dataclass(frozen=True)
class _Peak:
    score: float
    yaw: float
    shift: tuple[float, float]


def _peaks(correlation: Floats, pixel: float, yaw: float, count: int) -> list[_Peak]:
    """Return the strongest local maxima of one correlation picture."""
    work = correlation.copy()
    size = work.shape[0]
    found = []
    for _ in range(count):
        i, j = np.unravel_index(int(np.argmax(work)), work.shape)
        shift = tuple(float((k if k < size // 2 else k - size) * pixel) for k in (i, j))
        found.append(_Peak(float(work[i, j]), yaw, (shift[0], shift[1])))
        rows, columns = (np.arange(k - 2, k + 3) % size for k in (i, j))
        work[np.ix_(rows, columns)] = -np.inf
    return found


def _distinct(peaks: list[_Peak], count: int, yaw_gap: float, shift_gap: float) -> list[_Peak]:
    """Keep the best peaks that are not near a better one."""
    kept: list[_Peak] = []
    for peak in sorted(peaks, key=lambda p: -p.score):
        near = any(
            abs((peak.yaw - k.yaw + np.pi) % (2 * np.pi) - np.pi) < yaw_gap
            and np.hypot(peak.shift[0] - k.shift[0], peak.shift[1] - k.shift[1]) < shift_gap
            for k in kept
        )
        if not near:
            kept.append(peak)
        if len(kept) == count:
            break
    return kept


def _search(
    before_xy: Floats, after_xy: Floats, pixel: float, count: int, yaws: int | None = None
) -> list[_Peak]:
    """Correlate pictures of standing points over all yaws, or over so many of them."""
    radius = float(np.linalg.norm(before_xy, axis=1).max(initial=pixel))
    reach = max(radius, float(np.linalg.norm(after_xy, axis=1).max(initial=pixel)))
    pixel = max(pixel, reach / 250.0)
    size = fft.next_fast_len(int(2.0 * (radius + reach) / pixel) + 12, real=True)
    corner = np.full(2, -0.5 * size * pixel)
    # both pictures are band-passed: once here for both of them
    spectrum = fft.rfft2(_picture(after_xy, corner, pixel, size)) * _band(size) ** 2
    steps = yaws or int(np.clip(np.ceil(2 * np.pi * radius / (1.5 * pixel)), 120, 720))
    peaks = []
    for yaw in 2 * np.pi * np.arange(steps) / steps:
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        other = fft.rfft2(_picture(before_xy @ turn.T, corner, pixel, size))
        correlation = fft.irfft2(spectrum * np.conj(other), s=(size, size))
        peaks += _peaks(correlation, pixel, float(yaw), 3 if yaws is None else 2 * count)
    return _distinct(peaks, count, 3.0 * 2 * np.pi / steps, 3.0 * pixel)


def _ground_heights(level: Level, cell: float) -> tuple[Floats, Floats]:
    """Lowest near-horizontal point of every cell: centres (K, 2) and heights (K,) [m]."""
    flat = level.xyz[np.abs(level.planes.normals[:, 2]) > 0.8]
    ij = np.floor(flat[:, :2] / cell).astype(np.int64)
    order = np.lexsort((flat[:, 2], ij[:, 1], ij[:, 0]))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.any(np.diff(ij[order], axis=0) != 0, axis=1)
    lowest = order[first]
    return np.asarray((ij[lowest] + 0.5) * cell, dtype=np.float64), flat[lowest, 2]


def _height_offset(pose: Floats, before: Level, after: Level, cell: float = 3.0) -> float:
    """Median ground height of after minus before where they overlap; 0 if nowhere [m]."""
    xy_before, z_before = _ground_heights(
        Level(before.leaf, transform_points(pose, before.xyz), before.planes), cell
    )
    xy_after, z_after = _ground_heights(after, cell)
    lookup = {
        tuple(c): z for c, z in zip(np.floor(xy_after / cell).astype(int).tolist(), z_after, strict=True)
    }
    pairs = zip(np.floor(xy_before / cell).astype(int).tolist(), z_before, strict=True)
    offsets = [lookup[tuple(c)] - z for c, z in pairs if tuple(c) in lookup]
    return float(np.median(offsets)) if offsets else 0.0


def _standing(level: Level) -> Floats:
    """Xy (K, 2) of the points of a levelled cloud that belong to standing things."""
    return level.xyz[np.abs(level.planes.normals[:, 2]) < _STANDING, :2]


def _turned(level: Level, rotation: Floats) -> Level:
    planes = level.planes
    turned = LocalPlanes(planes.normals @ rotation[:3, :3].T, planes.curvature, planes.count)
    return Level(level.leaf, transform_points(rotation, level.xyz), turned)


def propose(before: Level, after: Level, pixel: float = 2.0, count: int = 12) -> list[StartPose]:
    """Propose start poses for clouds that share no frame.

    Parameters
    ----------
    before, after : Level
        At about 1 m leaf, each roughly centred on zero, z up within 25 deg.
    pixel : float
        Of the pictures [m]; grows with the extent.
    count : int
        Candidates wanted.

    Returns
    -------
    list of Candidate
        Best score first; empty if either cloud has nothing that stands.
    """
    level_before, level_after = levelling(before), levelling(after)
    flat_before, flat_after = _turned(before, level_before), _turned(after, level_after)
    xy_before, xy_after = _standing(flat_before), _standing(flat_after)
    if len(xy_before) < 50 or len(xy_after) < 50:
        return []
    candidates = []
    for peak in _search(xy_before, xy_after, pixel, count):
        turn = Rotation.from_euler("z", peak.yaw).as_matrix()
        pose = make_pose(turn, np.array([*peak.shift, 0.0]))
        pose[2, 3] = _height_offset(pose, flat_before, flat_after)
        candidates.append(StartPose(level_after.T @ pose @ level_before, peak.score))
    return candidates


def propose_shifts(
    before: Level, after: Level, pose: Floats, pixel: float, count: int = 4
) -> list[StartPose]:
    """Propose poses that differ from a fitted one by a level shift, the best first.

    Parameters
    ----------
    before, after : Level
        Coarsest levels.
    pose : (4, 4) float64
        ``T_after_before``; at it both clouds are upright within a few degrees.
    pixel : float
        Of the pictures from above [m].
    count : int
        Proposals wanted; the fitted pose itself is none.
    """
    moved = _turned(before, pose)
    pictures = _standing(moved), _standing(after)
    if min(map(len, pictures)) < 50:
        return []
    middle = np.vstack(pictures).mean(axis=0)
    found = _search(pictures[0] - middle, pictures[1] - middle, pixel, count + 1, yaws=1)
    candidates = []
    for peak in found:
        if np.hypot(*peak.shift) < 3.0 * pixel:
            continue
        aside = make_pose(np.eye(3), np.array([*peak.shift, 0.0]))
        aside[2, 3] = _height_offset(aside, moved, after)
        candidates.append(StartPose(aside @ pose, peak.score))
    return candidates[:count]

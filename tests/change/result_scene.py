"""A small made-up change result with every label, in MGA coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import box

from subiaco_change.records import ChangeRecord, ChangeResult, GroundChange, Registration
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.findings import Finding
from subiaco_geo.frames import exp_se3

ORIGIN = np.array([391_200.0, 6_464_500.0, 30.0])
SIZE = (110.0, 70.0)
# id, class, label, west, south, width, depth, height before, height after (0 where it does not stand)
OBJECTS = (
    (1, Semantic.BUILDING, Change.INCREASED, 10.0, 45.0, 12.0, 9.0, 4.0, 7.0),
    (2, Semantic.BUILDING, Change.REMOVED, 35.0, 45.0, 10.0, 8.0, 4.5, 0.0),
    (3, Semantic.BUILDING, Change.UNCHANGED, 60.0, 46.0, 14.0, 9.0, 5.0, 5.0),
    (4, Semantic.VEGETATION, Change.ADDED, 85.0, 40.0, 5.0, 5.0, 0.0, 6.0),
    (5, Semantic.VEGETATION, Change.DECREASED, 20.0, 8.0, 6.0, 6.0, 8.0, 5.0),
    (6, Semantic.MOBILE, Change.ADDED, 45.0, 22.0, 4.5, 1.8, 0.0, 1.5),
    (7, Semantic.MOBILE, Change.NOT_REPORTED, 65.0, 22.0, 4.5, 1.8, 1.5, 1.6),
    (8, Semantic.BUILDING, Change.UNOBSERVED, 92.0, 55.0, 12.0, 10.0, 0.0, 5.0),
    (9, Semantic.OTHER, Change.UNCHANGED, 52.0, 35.0, 0.5, 0.5, 6.0, 6.0),
)


class SceneConfig(StrictModel):
    """Stands for the change configuration."""

    leaf: float = 0.25
    seed: int = 7


def _ground() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.meshgrid(np.arange(0.125, SIZE[0], 0.25), np.arange(0.125, SIZE[1], 0.25))
    flat = np.stack([x.ravel(), y.ravel(), 0.02 * x.ravel()], axis=1)
    return flat, (flat[:, 0] > 75) & (flat[:, 0] < 85) & (flat[:, 1] > 10) & (flat[:, 1] < 16)


def _solid(spec: tuple, height: float, rng: np.random.Generator) -> NDArray[np.float64]:
    _, semantic, _, west, south, width, depth, *_ = spec
    count = int(200 + 30 * width * depth)
    xyz = rng.uniform([west, south, 0.2], [west + width, south + depth, height], (count, 3))
    if semantic is Semantic.VEGETATION:
        centre = np.array([west + width / 2, south + depth / 2, 0.6 * height])
        offset = rng.normal(size=(count, 3))
        offset /= np.linalg.norm(offset, axis=1, keepdims=True)
        xyz = centre + offset * np.array([width / 2, depth / 2, 0.4 * height])
    if semantic is Semantic.BUILDING:
        roof = count // 2
        xyz[:roof, 2] = height + 0.3 * np.abs(xyz[:roof, 0] - west - width / 2) * -0.6 + 0.9
    return xyz + np.array([0.0, 0.0, 0.02 * west])


def epoch_cloud(which: str, seed: int = 7) -> PointCloud:
    """Return the labelled cloud of ``before`` or ``after``."""
    rng = np.random.default_rng(seed + (which == "after"))
    flat, strip = _ground()
    label = np.full(len(flat), int(Change.UNCHANGED))
    label[strip] = int(Change.INCREASED)
    label[flat[:, 0] > 95] = int(Change.UNOBSERVED)
    instance = np.where(strip, 10, -1)
    if which == "after":
        flat[strip, 2] += 0.25
    parts = [(flat, np.zeros(len(flat), int), label, instance)]
    for spec in OBJECTS:
        height = spec[7] if which == "before" else spec[8]
        if height > 0:
            xyz = _solid(spec, height, rng)
            same = [np.full(len(xyz), int(value)) for value in (spec[1], spec[2], spec[0])]
            parts.append((xyz, *same))
    xyz, semantic, change, ids = (np.concatenate(column) for column in zip(*parts, strict=True))
    count = len(xyz)
    fields = {
        "semantic": semantic.astype(np.uint8),
        "change": change.astype(np.uint8),
        "instance": ids.astype(np.int32),
        "confidence": rng.uniform(0.5, 1.0, count).astype(np.float32),
        "lod95": rng.uniform(0.02, 0.05, count).astype(np.float32),
        "intensity": (40 + 20 * semantic + rng.normal(0, 5, count)).clip(0).astype(np.float32),
    }
    fields["lod95"][:50] = np.inf
    return PointCloud(xyz, ORIGIN.copy(), "EPSG:7850", fields)


def _record(spec: tuple) -> ChangeRecord:
    number, semantic, change, west, south, width, depth, old, new = spec
    x, y = ORIGIN[0] + west + width / 2, ORIGIN[1] + south + depth / 2
    paired = old > 0 and new > 0
    nan = float("nan")
    corner = ORIGIN[:2] + np.array([west, south])
    return ChangeRecord(
        object_id=number,
        semantic=semantic,
        change=change,
        id_before=(number, 100 + number) if number == 1 else ((number,) if old > 0 else ()),
        id_after=(number,) if new > 0 else (),
        match_kind="merge" if number == 1 else ("one_to_one" if paired else "none"),
        delta_h_m=new - old if paired else nan,
        delta_v_m3=(new - old) * width * depth,
        delta_v_surface_m3=(new - old) * (width + depth),
        delta_c_m=0.12 if paired else nan,
        iou_3d=0.61 if paired else nan,
        d_perp_m=0.034 if paired else nan,
        lod95_m=0.041 if number != 4 else float("inf"),
        observed_fraction=0.05 if change is Change.UNOBSERVED else 0.97,
        evidence="observed",
        score_paper=0.8 if paired and semantic is not Semantic.MOBILE else nan,
        confidence=0.5 + 0.04 * number,
        n_before=400 if old > 0 else 0,
        n_after=420 if new > 0 else 0,
        x=x,
        y=y,
        z=ORIGIN[2] + max(old, new) / 2,
        footprint=box(*corner, *(corner + np.array([width, depth]))),
        reason=f"rule {number}: dh {new - old:+.1f} m > 0.50 m & gate",
    )


def _patch() -> ChangeRecord:
    spec = (10, Semantic.GROUND, Change.INCREASED, 75.0, 10.0, 10.0, 6.0, 1.0, 1.25)
    return _record(spec)


def ground_raster() -> GroundChange:
    """Return a 2 m raster whose cell (row 27, column 38) holds +0.25 m."""
    shape = (int(SIZE[1] / 2), int(SIZE[0] / 2))
    dz = np.zeros(shape, dtype=np.float32)
    dz[27:30, 38:42] = 0.25
    dz[0, 0] = np.nan
    return GroundChange(dz, np.full(shape, 0.9, np.float32), ORIGIN[0], ORIGIN[1] + SIZE[1], 2.0)


def scene_result(seed: int = 7) -> ChangeResult:
    """Return the whole result."""
    registration = Registration(
        T_local=exp_se3([0.0, 0.0, np.radians(0.4), 0.31, -0.12, 0.05]),
        origin=ORIGIN + np.array([55.0, 35.0, 0.0]),
        sigma_reg_m=0.006,
        rmse_m=0.021,
        inlier_ratio=0.93,
        pose_std=np.array([1e-5, 1e-5, 2e-5, 0.002, 0.002, 0.004]),
        method="NDT and point-to-plane pyramid",
        warnings=("the southern edge overlaps by less than 20 m",),
        details={"iterations": 14.0},
    )
    return ChangeResult(
        records=(*(_record(spec) for spec in OBJECTS), _patch()),
        before=epoch_cloud("before", seed),
        after=epoch_cloud("after", seed),
        registration=registration,
        ground=ground_raster(),
        seconds={"register": 1.5, "decide": 0.25},
        findings=(Finding("scene", "warning", "epoch 'before' has no visibility layer <test & escape>"),),
    )

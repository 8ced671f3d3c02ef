"""The truth files: trajectory, labelled points, object table, scene description."""

from __future__ import annotations

import csv
import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from subiaco_geo.codes import Change
from subiaco_geo.config import config_hash
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.trajectories import Trajectory, write_tum
from subiaco_sim.drives import MAP_CRS, START_NS, WORLD, Drive, Survey, warp_of
from subiaco_sim.gate_margins import near_gates
from subiaco_sim.labels import Labels, TrueChange
from subiaco_sim.map_errors import MapWarp
from subiaco_sim.presets import family_of, preset_hash, simulator_hash
from subiaco_sim.scene import CLASS_NAMES, GROUND, CompiledScene, GroundItem, Item
from subiaco_sim.seeing import OtherDrive, seen_from
from subiaco_sim.vehicle import MOUNTINGS


def write_trajectory(directory: Path, drive: Drive, warp: MapWarp) -> Trajectory:
    """Write lidar_link in the map CRS at every scan's last column, where the epoch's map has it."""
    times_ns = drive.scan_end_ns()
    poses = warp.pose(drive.lidar_poses(times_ns))
    trajectory = Trajectory(times_ns, WORLD.poses_to_map(poses, MAP_CRS))
    write_tum(directory / "trajectory.tum", trajectory)
    return trajectory


def point_changes(
    survey: Survey, epoch: str, labels: Labels, xyz: Floats, object_id: Ints
) -> NDArray[np.uint8]:
    """Return the change code of points (N, 3) in ENU: their object's, 255 where the other drive is blind."""
    other = survey.drives["after" if epoch == "before" else "before"]
    elevations = other.info.beam_altitude_angles
    view = OtherDrive(
        other.compiled,
        other.lidar_poses(other.scan_end_ns()),
        survey.config.lidar.max_range,
        (float(np.min(elevations)), float(np.max(elevations))),
    )
    seen = seen_from(view, xyz, object_id, labels.reshaped, survey.config.truth)
    return np.where(seen, labels.change[object_id], Change.UNOBSERVED).astype(np.uint8)


def write_points(
    directory: Path, labels: Labels, xyz: Floats, object_id: Ints, change: NDArray[np.uint8], warp: MapWarp
) -> None:
    """Write points.npz: xyz in the map CRS, where the epoch's map has them, object, class, change."""
    arrays: dict[str, Any] = {
        "xyz": WORLD.points_to_map(warp.apply(xyz), MAP_CRS),
        "object": object_id.astype(np.int32),
        "class": labels.semantic[object_id].astype(np.uint8),
        "change": change,
    }
    np.savez(directory / "points.npz", **arrays)


def _round(value: float) -> float | str:
    return "" if np.isnan(value) else round(float(value), 3)


def _item_row(item: Item, true: TrueChange) -> dict[str, object]:
    bodies = [b for b in (true.after, true.before) if b is not None]
    east, north, height = WORLD.points_to_map(bodies[0].centroid[None], MAP_CRS)[0]
    return {
        "object_id": item.object_id,
        "kind": item.kind,
        "class": item.semantic,
        "class_name": CLASS_NAMES[item.semantic],
        "change": int(true.change),
        "label": true.change.label,
        "event": item.event,
        "x": round(east, 3),
        "y": round(north, 3),
        "z": round(height, 3),
        "h95_before_m": round(true.before.h95, 3) if true.before else "",
        "h95_after_m": round(true.after.h95, 3) if true.after else "",
        "volume_before_m3": round(true.before.volume, 2) if true.before else "",
        "volume_after_m3": round(true.after.volume, 2) if true.after else "",
        "delta_h_m": _round(true.delta_h),
        "delta_v_m3": _round(true.delta_v),
        "delta_c_m": _round(true.delta_c),
        "iou_3d": _round(true.iou),
        "area_m2": round(0.25 * len(bodies[0].cells), 2),
    }


def _ground_row(item: GroundItem, survey: Survey, labels: Labels) -> dict[str, object]:
    patch = item.patch
    foot = np.array([[patch.x, patch.y, survey.scene.terrain_at("after").height_at(patch.x, patch.y)]])
    east, north, height = WORLD.points_to_map(foot, MAP_CRS)[0]
    change = Change(int(labels.change[item.object_id]))
    return {
        "object_id": item.object_id,
        "kind": "ground patch",
        "class": GROUND,
        "class_name": CLASS_NAMES[GROUND],
        "change": int(change),
        "label": change.label,
        "event": item.event,
        "x": round(east, 3),
        "y": round(north, 3),
        "z": round(height, 3),
        "delta_h_m": round(patch.rise, 3),
        "delta_v_m3": round(patch.rise * patch.area, 3),
        "area_m2": round(patch.area, 2),
    }


def write_objects(path: Path, survey: Survey, labels: Labels, seen: dict[str, tuple[Ints, Ints]]) -> None:
    """Write objects.csv: what every object is, what happened to it, and how much of it was seen.

    ``seen`` maps an epoch to points by object id: all, and those that are not 255.
    """
    rows = [_item_row(item, labels.measured[item.object_id]) for item in survey.scene.items]
    rows += [_ground_row(item, survey, labels) for item in survey.scene.ground_items]
    near = near_gates(survey.scene, labels)
    for row in rows:
        row["near_gate"] = int(row["object_id"] in near)
        for epoch, (total, decidable) in seen.items():
            number = int(str(row["object_id"]))
            row[f"n_{epoch}"] = int(total[number])
            row[f"n_{epoch}_seen"] = int(decidable[number])
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def scene_hash(scenes: list[CompiledScene]) -> str:
    """Return a short hash of the geometry of both epochs, to 0.1 mm."""
    digest = hashlib.sha256()
    for scene in scenes:
        digest.update(np.round(scene.mesh.vertices * 1e4).astype(np.int64).tobytes())
        digest.update(scene.object_of_triangle.tobytes())
    return digest.hexdigest()[:16]


def write_scene(path: Path, survey: Survey, labels: Labels, bags: dict[str, str]) -> None:
    """Write scene.yaml: everything that is needed to judge or to repeat the survey."""
    config = survey.config
    items: list[Item | GroundItem] = [*survey.scene.items, *survey.scene.ground_items]
    document = {
        "preset": config.preset,
        "seed": config.seed,
        "city_loop": config.city_loop,
        "simulator_hash": simulator_hash(),
        "preset_hash": preset_hash(config.preset),
        "family": family_of(config.preset),
        "scene_hash": scene_hash([d.compiled for d in survey.drives.values()]),
        "config_hash": config_hash(config),
        "config": json.loads(config.model_dump_json()),
        "crs": MAP_CRS,
        "height": "ellipsoidal (GDA2020)",
        "origin": {"latitude": WORLD.latitude_deg, "longitude": WORLD.longitude_deg, "height": WORLD.height},
        "T_after_before": warp_of(survey, "before").T_true_map(WORLD, MAP_CRS).tolist(),
        "epochs": {
            epoch: {
                "start_ns": START_NS[epoch],
                "scans": d.scans,
                "lidar": d.info.prod_line,
                "packets_sha256": bags.get(epoch, ""),
            }
            for epoch, d in survey.drives.items()
        },
        "lidar": {
            "model": survey.drives["after"].info.prod_line,
            "mode": config.mode.value,
            "dual_return": config.dual_return,
        },
        "mountings_in_base_link": {name: asdict(m) for name, m in MOUNTINGS.items()},
        "classes": dict(enumerate(CLASS_NAMES)),
        "changes": {int(c): c.label for c in Change},
        "item_class": {i.object_id: int(labels.semantic[i.object_id]) for i in items},
        "moving": [m.object_id for m in survey.scene.moving],
        "item_change": {i.object_id: int(labels.change[i.object_id]) for i in items},
    }
    path.write_text(yaml.safe_dump(document, sort_keys=False))

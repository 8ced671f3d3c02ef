"""Replace parts of the method by functions of your own: registration, segmentation, decision.

python docs/tutorials/own_functions.py BEFORE AFTER OUTPUT
"""

import sys
from dataclasses import replace

import numpy as np
from scipy import ndimage

import subiaco


def register_by_corner(before: subiaco.PointCloud, after: subiaco.PointCloud) -> np.ndarray:
    """Return the shift between the lowest corners: right where both epochs cover the same ground."""
    transform = np.eye(4)
    transform[:3, 3] = after.world().min(axis=0) - before.world().min(axis=0)
    return transform


def segment_by_height(cloud: subiaco.PointCloud) -> tuple[np.ndarray, np.ndarray]:
    """Call everything 0.5 m above the lowest point a building, and connected 1 m cells one object."""
    high = cloud.xyz[:, 2] > cloud.xyz[:, 2].min() + 0.5
    cells = np.floor(cloud.xyz[:, :2] - cloud.xyz[:, :2].min(axis=0)).astype(int)
    occupied = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    occupied[tuple(cells[high].T)] = True
    numbers, _ = ndimage.label(occupied)
    semantic = np.where(high, subiaco.Semantic.BUILDING, subiaco.Semantic.GROUND)
    return semantic.astype(np.uint8), np.where(high, numbers[tuple(cells.T)], 0).astype(np.int32)


def doubt_thin_objects(row: subiaco.ChangeRecord) -> subiaco.ChangeRecord:
    """Halve the confidence of changed objects with fewer than 200 points."""
    changed = row.change not in (subiaco.Change.UNCHANGED, subiaco.Change.UNOBSERVED)
    if not changed or row.n_before + row.n_after >= 200:
        return row
    reason = f"{row.reason} Only {row.n_before + row.n_after} points of 200: confidence halved."
    return replace(row, confidence=row.confidence / 2, reason=reason)


if __name__ == "__main__":
    changes = subiaco.compare(
        *sys.argv[1:4],
        registration=register_by_corner,
        segmentation=segment_by_height,
        decision=doubt_thin_objects,
    )
    print(changes.table[["object_id", "class", "label", "confidence"]].to_string(index=False))

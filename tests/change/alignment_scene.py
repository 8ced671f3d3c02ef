"""A street of ground and walls whose two epochs differ by what a test says."""

from __future__ import annotations

import numpy as np

from subiaco_change.records import Registration
from subiaco_geo.clouds import PointCloud

UP = np.array([0.0, 0.0, 1.0])


def street(seed, bend=None, length=160.0, noise=0.01, origin=(0.0, 0.0, 0.0)):
    """Sample ground and walls along and across; ``bend(xyz) -> (N, 3)`` moves what it likes."""
    rng = np.random.default_rng(seed)
    n = int(length * 60 * 5)
    parts = [np.column_stack([rng.uniform(0, length, n), rng.uniform(0, 60, n), np.zeros(n)])]
    normals = [np.tile(UP, (n, 1))]
    for y in (12.0, 48.0):
        for x in np.arange(4.0, length - 12, 20.0):
            m = 12 * 5 * 10
            parts.append(
                np.column_stack([x + rng.uniform(0, 12, m), np.full(m, y), rng.uniform(0.6, 5.6, m)])
            )
            normals.append(np.tile([0.0, 1.0, 0.0], (m, 1)))
            m = 10 * 5 * 10
            back = y + (10.0 if y > 30 else -10.0)
            parts.append(
                np.column_stack([np.full(m, x), rng.uniform(*sorted((y, back)), m), rng.uniform(0.6, 5.6, m)])
            )
            normals.append(np.tile([1.0, 0.0, 0.0], (m, 1)))
    xyz, normals = np.vstack(parts), np.vstack(normals)
    xyz = xyz + (0.0 if bend is None else bend(xyz)) + rng.normal(0, noise, xyz.shape)
    return PointCloud(xyz, np.array(origin), fields={"normals": normals})


def rigid(std=1e-4, origin=(80.0, 30.0, 0.0)):
    """Return an identity registration that is known to ``std`` in every component."""
    return Registration(
        np.eye(4), np.asarray(origin, float), 0.003, 0.01, 0.9, np.array([1e-6] * 3 + [std] * 3), "identity"
    )

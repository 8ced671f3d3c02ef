"""An injected map on disk: a map directory with its truth in the simulator's format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from subiaco_evaluation.injection.config import InjectionConfig
from subiaco_evaluation.injection.inject import Injected
from subiaco_geo.atomic import whole_directory
from subiaco_geo.clouds import PointCloud
from subiaco_geo.maps import write_map
from subiaco_geo.trajectories import write_tum

_TRUTH = ("object", "semantic", "change")


def write_injected(
    directory: Path, source: Path, injected: Injected, config: InjectionConfig, overwrite: bool = False
) -> None:
    """Write the edited map, and the truth of both epochs beside it.

    ``subiaco change MAP DIRECTORY`` reads the map, ``subiaco evaluate CHANGE_DIR
    DIRECTORY`` the truth: ``truth/objects.csv``, ``truth/scene.yaml`` and
    ``<epoch>/truth/points.npz``, as a simulated survey has them. What was not
    edited is Unchanged there, and its class is what our own labels say.

    Raises
    ------
    InputError
        The directory exists and ``overwrite`` is False, or it is not a map.
    """
    after = injected.after
    plain = {n: v for n, v in after.cloud.fields.items() if n not in _TRUTH}
    cloud = PointCloud(after.cloud.xyz, after.cloud.origin, after.cloud.crs, plain)
    info = {
        **after.info,
        "injected": {"source": str(source), "seed": config.seed, "left_out": injected.left_out},
    }
    with whole_directory(directory, overwrite=overwrite, marker="map.yaml") as target:
        inner = target / "map"
        write_map(inner, replace(after, cloud=cloud, info=info))
        for file in inner.iterdir():
            file.rename(target / file.name)
        inner.rmdir()
        (target / "truth").mkdir()
        pd.DataFrame(injected.rows).to_csv(target / "truth" / "objects.csv", index=False)
        (target / "truth" / "scene.yaml").write_text(yaml.safe_dump(_scene(source, injected, config)))
        for epoch, survey in (("before", injected.before), ("after", injected.after)):
            folder = target / epoch / "truth"
            folder.mkdir(parents=True)
            _write_points(folder / "points.npz", survey.cloud)
            if survey.trajectory is not None:
                write_tum(folder / "trajectory.tum", survey.trajectory)


def _write_points(path: Path, cloud: PointCloud) -> None:
    arrays: dict[str, Any] = {
        "xyz": cloud.world(),
        "object": np.asarray(cloud.fields["object"]).astype(np.int32),
        "class": cloud.fields["semantic"],
        "change": cloud.fields["change"],
    }
    np.savez_compressed(path, **arrays)


def _scene(source: Path, injected: Injected, config: InjectionConfig) -> dict[str, Any]:
    return {
        "preset": "injected",
        "seed": config.seed,
        "source": str(source),
        "crs": injected.after.cloud.crs,
        "classes_are_estimated": True,
        "T_after_before": np.eye(4).tolist(),
        "left_out": injected.left_out,
        "config": config.model_dump(mode="json"),
    }

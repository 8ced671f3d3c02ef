"""Maps of one epoch: made from bags, or opened."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from subiaco_geo.config import load_config
from subiaco_geo.maps import load_epoch, write_map
from subiaco_geo.survey_map import SurveyMap


def as_settings(settings: Mapping[str, Any] | None) -> list[str]:
    """Return settings by their dotted name as the command line writes them: ``name=value``."""
    return [f"{name}={json.dumps(value)}" for name, value in (settings or {}).items()]


def open_map(path: str | Path, trajectory: str | Path | None = None) -> SurveyMap:
    """Open the map of one epoch, whole in memory.

    Parameters
    ----------
    path : path
        A map directory, or a bare cloud: ``.ply .las .laz .pcd``.
    trajectory : path, optional
        TUM file of the poses of the sensor, for a bare cloud.

    Returns
    -------
    SurveyMap
        ``cloud.world()`` are its points (N, 3) float64 [m] in ``crs``; ``cloud.fields`` their attributes;
        ``trajectory``, ``uncertainty`` and ``visibility`` are None where the map has none.

    Raises
    ------
    InputError
        There is no such map, or it is damaged.
    """
    return load_epoch(Path(path), None if trajectory is None else Path(trajectory))


def make_map(
    bags: Sequence[str | Path],
    output: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    config: Sequence[str | Path] = (),
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> SurveyMap:
    """Map the bags of one epoch and write the map directory.

    Parameters
    ----------
    bags : sequence of path
        rosbag2 folders, ``.mcap`` files or simulated epoch folders, each one recording.
    output : path
        Map directory to write.
    settings : mapping, optional
        Settings by their dotted name, such as ``{"crs": "EPSG:7850", "fusion.leaf": 0.25}``.
    config : sequence of path
        YAML files of settings; later ones win.
    workers : int
        Recordings read in parallel; the map does not depend on it.
    overwrite : bool
        Replace a map that is there.
    progress : callable, optional
        Called with the name of the stage and the fraction done.

    Returns
    -------
    SurveyMap

    Raises
    ------
    InputError
        A bag cannot be mapped, or the output exists.
    """
    from subiaco_geo.atomic import refuse_existing
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.pipeline import map_survey

    refuse_existing(Path(output), overwrite)
    model = load_config(MappingConfig, tuple(Path(file) for file in config), as_settings(settings))
    survey = map_survey([Path(bag) for bag in bags], model, progress, workers=workers)
    write_map(Path(output), survey, overwrite=overwrite)
    return survey

"""Maps of one epoch: made from bags, or opened."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from subiaco_geo.config import load_config
from subiaco_geo.maps import load_epoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.request import MappingRequest


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
        Poses of the sensor (TUM, SBET, RTKLIB, CSV), for a bare cloud.

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
    progress: Callable[[str, float], None] | None = None,
    **options: Any,
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
    progress : callable, optional
        Called with the name of the stage and the fraction done.
    **options
        The other fields of :class:`~subiaco.MappingRequest`: ``workers``, ``resume``, ``keep_checkpoint`` and
        ``overwrite``.

    Returns
    -------
    SurveyMap

    Raises
    ------
    InputError
        A bag cannot be mapped, an option is not known, or the output exists.
    """
    from subiaco_change.segmentation.classes import map_classes
    from subiaco_mapping.job import run_mapping

    model = load_config(MappingConfig, tuple(Path(file) for file in config), as_settings(settings))
    request = MappingRequest.of(bags=tuple(bags), output=output, config=model, **options)
    return run_mapping(request, progress, map_classes)

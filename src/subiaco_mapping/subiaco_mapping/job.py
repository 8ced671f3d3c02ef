"""The mapping job from recordings to a map directory, for the command and the Python API alike."""

from __future__ import annotations

import shutil
from collections.abc import Callable

from subiaco_geo.atomic import refuse_existing, refuse_foreign
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.absolute_positions.positioning import require_usable_files
from subiaco_mapping.checkpoint.checkpoint import checkpoint_folder, remove
from subiaco_mapping.fusion.full_density import FOLDER, GPS_BEHIND_TAI_S, Classifier, FullDensity
from subiaco_mapping.pipeline import map_survey, require_room_for
from subiaco_mapping.request import MappingRequest


def run_mapping(
    request: MappingRequest,
    progress: Callable[[str, float], None] | None = None,
    classify: Classifier | None = None,
) -> SurveyMap:
    """Map the recordings of one epoch, and write the map directory.

    Parameters
    ----------
    request : MappingRequest
    progress : callable, optional
        Called with the name of the stage and the fraction done.
    classify : callable, optional
        Gives the classes of returns where the settings ask for full density; see
        :class:`~subiaco_mapping.fusion.full_density.FullDensity`.

    Raises
    ------
    InputError
        A recording cannot be mapped, the output exists, control points or a reference cannot be read, or
        the disk has no room.
    """
    output = request.output
    refuse_existing(output, request.overwrite)
    refuse_foreign(output, "map.yaml")
    require_usable_files(request.config)
    require_room_for(request.bags, output)
    decode, returns = request.config.decode, checkpoint_folder(output) / FOLDER
    shutil.rmtree(returns, ignore_errors=True)  # of a run that was stopped
    density = FullDensity(returns, classify, decode.leap_seconds - GPS_BEHIND_TAI_S)
    survey = map_survey(
        request.bags, request.config, progress,
        checkpoint=checkpoint_folder(output), resume=request.resume, workers=request.workers,
        density=density,
    )  # fmt: skip
    if progress is not None:
        progress("writing map", 0.0)
    folders = {FOLDER: returns} if request.config.fusion.full_density else {}
    write_map(output, survey, overwrite=request.overwrite, folders=folders)
    if not request.keep_checkpoint:
        remove(checkpoint_folder(output))
    return survey

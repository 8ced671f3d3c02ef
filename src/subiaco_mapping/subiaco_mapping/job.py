"""The mapping job from recordings to a map directory, for the command and the Python API alike."""

from __future__ import annotations

from collections.abc import Callable

from subiaco_geo.atomic import refuse_existing, refuse_foreign
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.checkpoint.checkpoint import checkpoint_folder, remove
from subiaco_mapping.pipeline import map_survey, require_room_for
from subiaco_mapping.request import MappingRequest


def run_mapping(request: MappingRequest, progress: Callable[[str, float], None] | None = None) -> SurveyMap:
    """Map the recordings of one epoch, and write the map directory.

    Parameters
    ----------
    request : MappingRequest
    progress : callable, optional
        Called with the name of the stage and the fraction done.

    Raises
    ------
    InputError
        A recording cannot be mapped, the output exists, or the disk has no room.
    """
    output = request.output
    refuse_existing(output, request.overwrite)
    refuse_foreign(output, "map.yaml")
    require_room_for(request.bags, output)
    survey = map_survey(
        request.bags, request.config, progress,
        checkpoint=checkpoint_folder(output), resume=request.resume, workers=request.workers,
    )  # fmt: skip
    if progress is not None:
        progress("writing map", 0.0)
    write_map(output, survey, overwrite=request.overwrite)
    if not request.keep_checkpoint:
        remove(checkpoint_folder(output))
    return survey

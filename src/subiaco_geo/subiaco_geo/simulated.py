"""Which simulator, preset and scene a recording or a map comes from: named in every result made from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from subiaco_geo.config import load_yaml
from subiaco_geo.errors import InputError

if TYPE_CHECKING:
    from subiaco_geo.survey_map import SurveyMap

#: What names a simulated survey for good: a figure holds for this simulator and scene only.
_NAMES = ("preset", "seed", "simulator_hash", "preset_hash", "scene_hash")
#: Where ``map.yaml``, ``run.json`` and evaluations keep a list of such names.
SIMULATIONS = "simulations"


def name_simulation(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return what names a survey, from the content of its ``scene.yaml``; None for what that lacks."""
    return {key: scene.get(key) for key in _NAMES}


def simulation_of(path: Path) -> dict[str, Any] | None:
    """Return what names the simulated survey that a bag or fused map lies in; None for anything else.

    Parameters
    ----------
    path : Path
        An epoch folder, its ``bag/`` or a file in either.

    Raises
    ------
    InputError
        ``truth/scene.yaml`` of the survey cannot be read.
    """
    for folder in list(Path(path).resolve().parents)[:3]:
        said = folder / "truth" / "scene.yaml"
        if said.is_file():
            try:
                return name_simulation(load_yaml(said.read_text(encoding="utf-8")))
            except (OSError, yaml.YAMLError, AttributeError, UnicodeDecodeError) as error:
                raise InputError(f"{said}: cannot be read ({error}); simulate the survey again") from error
    return None


def distinct(simulations: Iterable[Mapping[str, Any] | None]) -> dict[str, list[dict[str, Any]]]:
    """Return every name once, in order, under :data:`SIMULATIONS`; nothing where nothing is simulated."""
    found: list[dict[str, Any]] = []
    for simulation in simulations:
        if simulation is not None and dict(simulation) not in found:
            found.append(dict(simulation))
    return {SIMULATIONS: found} if found else {}


def mark_simulated(survey: SurveyMap, recordings: Iterable[Path]) -> SurveyMap:
    """Return a map whose ``info`` names the simulated surveys that its recordings are of."""
    return replace(survey, info={**survey.info, **distinct(simulation_of(path) for path in recordings)})

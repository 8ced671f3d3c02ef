"""``quality.html`` and ``quality.json``: how good a map is, beside the map itself."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.manifest import LEGEND
from subiaco_mapping.map_quality import plots as drawing
from subiaco_mapping.map_quality.figures import Assessment, assess
from subiaco_mapping.map_quality.time_series import BESIDE
from subiaco_mapping.map_quality.verdict import amount
from subiaco_mapping.survey_graph.solution import GraphSolution

PAGE, FIGURES = "quality.html", "quality.json"


def with_quality(survey: SurveyMap, solution: GraphSolution, config: MappingConfig) -> SurveyMap:
    """Return the map with its quality report among its pages.

    Parameters
    ----------
    survey : SurveyMap
    solution : GraphSolution
        What the map was built from.
    config : MappingConfig
    """
    if not config.quality.enabled:
        return survey
    found = assess(survey, solution, config)
    text = json.dumps(found.facts, indent=1, allow_nan=False) + "\n"
    pages = {PAGE: render(found, solution, config), FIGURES: text}
    return replace(survey, pages={**survey.pages, **pages})


def render(found: Assessment, solution: GraphSolution, config: MappingConfig) -> str:
    """Return the page; it needs no other file."""
    environment = Environment(
        loader=PackageLoader("subiaco_mapping", "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["amount"] = amount
    pictures = {
        name: "data:image/png;base64," + base64.b64encode(png).decode("ascii")
        for name, png in drawing.pictures(found, solution).items()
    }
    return environment.get_template("quality.html.j2").render(
        facts=found.facts, pictures=pictures, legend=LEGEND, quality=config.quality, beside=BESIDE
    )

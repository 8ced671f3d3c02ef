"""``evaluation.json`` and its readable page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from subiaco_change.outputs.json_text import plain
from subiaco_evaluation.reliability_plot import draw_reliability
from subiaco_geo.atomic import whole_file


def write_evaluation(result: Mapping[str, Any], out_dir: Path) -> None:
    """Write ``evaluation.json``, ``evaluation.md`` and ``reliability.png``.

    Simulated truth is labelled as simulated.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    document = plain(result)
    with whole_file(out_dir / "evaluation.json") as path:
        path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")
    with whole_file(out_dir / "evaluation.md") as path:
        path.write_text(evaluation_markdown(document))
    if document.get("reliability"):
        with whole_file(out_dir / "reliability.png") as path:
            draw_reliability(path, document["reliability"])


def evaluation_markdown(document: Mapping[str, Any]) -> str:
    """Return the page; missing values are a dash."""
    environment = Environment(  # Markdown for the disk, never sent to a browser as HTML
        loader=PackageLoader("subiaco_evaluation", "templates"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,  # noqa: S701
    )
    environment.filters["fixed"] = lambda v, d=1: "–" if v is None else f"{float(v):.{d}f}"
    return environment.get_template("evaluation.md.j2").render(e=document)

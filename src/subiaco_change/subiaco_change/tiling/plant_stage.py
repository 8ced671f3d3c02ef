"""Stage: the plants of the whole map decided against one another (Decision 18)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import shapely

from subiaco_change.decisions.confidence import decided_anew
from subiaco_change.decisions.object_decision import ObjectChange
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.vegetation_null import PlantMeasures, fit_null, null_of, null_words
from subiaco_change.records import ChangeRecord
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs


@dataclass(frozen=True)
class PlantRow:
    """A row of a tile on which the plants of the pair have a say: its number, measures and LoD95 [m]."""

    row: int
    plant: PlantMeasures
    lod: float


def plant_words(changes: list[ObjectChange]) -> str:
    """Write the plants among the rows of a tile as JSON."""
    rows = [PlantRow(k, c.plant, c.lod) for k, c in enumerate(changes) if c.plant is not None]
    return json.dumps([asdict(row) for row in rows])


def plant_rows(compared: Arrays) -> list[PlantRow]:
    """Read the plants of a tile."""
    return [
        PlantRow(words["row"], PlantMeasures(**words["plant"]), words["lod"])
        for words in json.loads(str(compared["plants"]))
    ]


def find_vegetation_null(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Fit what the unchanged plants of the whole pair differ by.

    Parameters
    ----------
    inputs : Inputs
        ``compared/<tile>`` of every tile.
    params : mapping
        ``config``.

    Returns
    -------
    arrays
        ``null``, JSON.
    """
    plants = [
        row.plant for tile in inputs.under("compared") for row in plant_rows(inputs[f"compared/{tile}"])
    ]
    return {"null": np.array(null_words(fit_null(plants, params["config"].plants.null_model)))}


def decide_tile(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Decide the plants of a tile again, with the null of the pair; all other rows stay as they are.

    Parameters
    ----------
    inputs : Inputs
        ``compared``, ``null``.
    params : mapping
        ``config``.

    Returns
    -------
    arrays
        ``records``, JSON of the rows in their order.
    """
    config = params["config"]
    null = null_of(str(inputs["null"]["null"]), config.plants.null_model)
    rows = [record_of(words) for words in json.loads(str(inputs["compared"]["records"]))]
    for found in plant_rows(inputs["compared"]):
        decision = decide_plant(found.plant, found.lod, config.decisions, null)
        rows[found.row] = decided_anew(rows[found.row], decision, config.confidence)
    return {"records": np.array(json.dumps([record_words(row) for row in rows]))}


def record_words(record: ChangeRecord) -> dict[str, Any]:
    """Return a row as what JSON holds, footprints as WKB."""
    words = {f.name: getattr(record, f.name) for f in fields(record)}
    return {**words, "footprint": shapely.to_wkb(record.footprint, hex=True)}


def record_of(words: Mapping[str, Any]) -> ChangeRecord:
    """Return the row that :func:`record_words` took apart."""
    return ChangeRecord(
        **{
            **words,
            "semantic": Semantic(words["semantic"]),
            "change": Change(words["change"]),
            "id_before": tuple(words["id_before"]),
            "id_after": tuple(words["id_after"]),
            "features": tuple(words["features"]),
            "footprint": shapely.from_wkb(words["footprint"]),
        }
    )

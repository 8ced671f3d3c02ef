"""Scores by family of simulated streets, and the gap to the family that nothing is tuned on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: The family that nothing is tuned or fitted on (``config/seeds.yaml``).
NEVER_TUNED = "dense"
TUNED = "suburb"


def by_family(pooled: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """Return the headline scores of every family and the gap between them.

    Parameters
    ----------
    pooled : mapping
        What :func:`~subiaco_evaluation.scoring.pool` returns for the scenes of each family.

    Returns
    -------
    dict or None
        ``scores`` by family; ``never_tuned``; ``generalisation_gap_miou_percent``: mIoU of the tuned
        family less that of the other one, None unless both are there. None without scenes of a family.
    """
    if not pooled:
        return None
    found = {name: _headline(result) for name, result in sorted(pooled.items())}
    gap = None
    if TUNED in found and NEVER_TUNED in found:
        gap = found[TUNED]["miou_percent"] - found[NEVER_TUNED]["miou_percent"]
    return {"scores": found, "never_tuned": NEVER_TUNED, "generalisation_gap_miou_percent": gap}


def _headline(result: Mapping[str, Any]) -> dict[str, Any]:
    objects, trust = result["objects"] or {}, result["reliability"] or {}
    clear = result["without_near_gate"] or {}
    return {
        "scenes": len(result["scenes"]),
        "miou_percent": result["grid"]["miou_percent"],
        "miou_without_near_gate_percent": clear["grid"]["miou_percent"] if clear else None,
        "precision_percent": objects.get("precision_percent"),
        "recall_percent": objects.get("recall_percent"),
        "ece_changed_rows_fraction": trust["changed_rows"]["ece_fraction"] if trust else None,
    }

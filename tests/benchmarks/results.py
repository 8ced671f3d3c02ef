"""What a benchmark found, left as JSON for ``bench.py``: rows of a table, peers that are absent, remarks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def keep(
    path: Path | None,
    rows: Sequence[Mapping[str, Any]],
    absent: Mapping[str, str] | None = None,
    remarks: Sequence[str] = (),
) -> None:
    """Write rows (column to number or text), peers with the reason of their absence, and remarks."""
    if path is not None:
        found = {"rows": list(rows), "absent": dict(absent or {}), "remarks": list(remarks)}
        path.write_text(json.dumps(found, indent=1), encoding="utf-8")


def rounded(value: float, digits: int = 3) -> float:
    """Return a number with so many significant digits."""
    return float(f"{value:.{digits}g}")

"""JSON without NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Turn arrays, paths and numpy scalars into JSON values; non-finite becomes null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, bool | int | str) or value is None else str(value)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write JSON without NaN, indented."""
    path.write_text(json.dumps(plain(document), indent=2, allow_nan=False) + "\n")

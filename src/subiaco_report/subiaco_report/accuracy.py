"""The accuracy statement of a delivery: positional uncertainty at 95 % in the form that surveyors sign."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.errors import InputError

#: Points below which a tested accuracy is not stated (ASPRS 2023, at least 30 checkpoints).
ENOUGH = 30
#: Factors to 95 %: heights; horizontal from the RMSE of the distance (NSSDA), and from the standard deviation
#: of one axis (circular error, ICSM SP1).
_VERTICAL, _HORIZONTAL_RMSE, _CIRCULAR = 1.96, 1.7308, 2.4477
_CHECK = ("points", "horizontal_points", "rmse_horizontal_m", "vertical_points", "rmse_vertical_m")


def read_check(path: Path) -> dict[str, Any]:
    """Read what ``subiaco check --json`` printed.

    Raises
    ------
    InputError
        Not the output of ``subiaco check --json``.
    """
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        return {name: known[name] for name in _CHECK}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not the output of 'subiaco check --json' ({error}); run it again"
        ) from error


def accuracy_facts(
    run: Mapping[str, Any], registration: Mapping[str, Any], check: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the numbers of the statement [m].

    Parameters
    ----------
    run, registration : mapping
        ``run.json`` and ``registration.json``.
    check : mapping or None
        Of :func:`read_check`, for the later map against control.

    Returns
    -------
    dict
        ``relative``: RMSE after alignment, and uncertainty of the alignment at 95 % in position and height;
        ``detection``: median level of detection; ``control``: RMSE and 95 % values, None where not tested.
    """
    std = np.array([np.nan if v is None else v for v in registration["pose_std"]], dtype=np.float64)
    axis = float(np.sqrt((std[3] ** 2 + std[4] ** 2) / 2.0))
    level = run.get("level_of_detection", {})
    sigma = registration["sigma_reg_m"]
    return {
        "relative": {
            "rmse_m": registration["rmse_m"],
            "sigma_m": sigma,
            "surface_95_m": None if sigma is None else _VERTICAL * float(sigma),
            "horizontal_95_m": _CIRCULAR * axis if np.isfinite(axis) else None,
            "vertical_95_m": _VERTICAL * float(std[5]) if np.isfinite(std[5]) else None,
        },
        "detection": {
            "median_m": level.get("median_where_known_m"),
            "share_without": level.get("share_without"),
        },
        "control": None if check is None else _control(check),
    }


def _control(check: Mapping[str, Any]) -> dict[str, Any]:
    horizontal, vertical = check["rmse_horizontal_m"], check["rmse_vertical_m"]
    fewest = min((check[name] for name in ("horizontal_points", "vertical_points") if check[name]), default=0)
    return {
        **check,
        "horizontal_95_m": None if horizontal is None else _HORIZONTAL_RMSE * float(horizontal),
        "vertical_95_m": None if vertical is None else _VERTICAL * float(vertical),
        "enough": fewest >= ENOUGH,
    }

"""Names of the learned methods, and the one-line error where PyTorch is missing."""

from __future__ import annotations

import importlib.util

from subiaco_geo.errors import InputError

RASTER_METHODS = ("dsm-siamese", "dsm-fc-ef")
POINT_METHODS = ("siamese-kpconv", "triplet-kpconv", "efs-kpconv", "dc3dcd")
LEARNED_METHODS = (*RASTER_METHODS, *POINT_METHODS)


def require_torch(method: str) -> None:
    """Raise where PyTorch is not installed.

    Raises
    ------
    InputError
    """
    if importlib.util.find_spec("torch") is None:
        raise InputError(f"{method}: PyTorch is not installed; 'make learned' installs it (CPU, 0.2 GB)")

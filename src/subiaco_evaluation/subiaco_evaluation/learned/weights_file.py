"""Trained weights with their training record in one ``.npz`` file, without pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_evaluation.learned.methods import LEARNED_METHODS
from subiaco_geo.array_files import read_arrays
from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError

_PREFIX = "weight/"
_WHAT, _REMEDY = "a file of trained weights", "give a file that 'subiaco train' wrote"
SHIPPED = Path(__file__).parent / "weights"


def text_array(value: Any) -> NDArray[np.uint8]:
    """Return a value as JSON bytes."""
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def array_text(array: NDArray[Any]) -> Any:
    """Return the value that :func:`text_array` stored."""
    return json.loads(array.astype(np.uint8).tobytes().decode())


def write_weights(path: Path, weights: Mapping[str, NDArray[Any]], record: Mapping[str, Any]) -> None:
    """Write weights, matrices in half precision, and their record."""
    arrays: dict[str, NDArray[Any]] = {
        _PREFIX + name: value.astype(np.float16) if value.ndim > 1 else value
        for name, value in weights.items()
    }
    named = {**record, "arrays": sorted(weights)}
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, record=text_array(named), **arrays)  # type: ignore[arg-type]


def read_record(path: Path) -> dict[str, Any]:
    """Read the record of trained weights.

    Raises
    ------
    InputError
        Missing, damaged, or no record of a method that is known.
    """
    try:
        record = array_text(read_arrays(path, ["record"], _WHAT, _REMEDY)["record"])
        known = record["method"] in LEARNED_METHODS and all(isinstance(n, str) for n in record["arrays"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: not {_WHAT} ({' '.join(str(error).split())}); {_REMEDY}") from error
    if not known:
        raise InputError(f"{path}: not {_WHAT} (method {record['method']!r}); {_REMEDY}")
    return dict(record)


def read_weights(path: Path, method: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read weights of a method in single precision, and their record.

    Raises
    ------
    InputError
        As :func:`read_record`, or the weights are of another method.
    """
    record = read_record(path)
    if record["method"] != method:
        raise InputError(f"{path}: weights of {record['method']}, not of {method}; {_REMEDY}")
    arrays = read_arrays(path, [_PREFIX + name for name in record["arrays"]], _WHAT, _REMEDY)
    plain = {name.removeprefix(_PREFIX): value for name, value in arrays.items()}
    return {n: v.astype(np.float32) if v.dtype.kind == "f" else v for n, v in plain.items()}, record


def find_weights(method: str, given: str) -> Path:
    """Return the file of weights: the given one, or the one that is shipped.

    Raises
    ------
    InputError
        There is none.
    """
    path = Path(given) if given else SHIPPED / f"{method}.npz"
    if not path.is_file():
        name = f"{path}: no such file" if given else f"{method}: no trained weights are shipped"
        raise InputError(f"{name}; train them ('subiaco train {method}') and give --set learned.weights=FILE")
    return path

"""Configuration: one strict model per room, one file form for nodes and command line.

Files are in ROS parameter form::

    /**:
      ros__parameters:
        odometry:
          voxel: 1.0

Later files and ``key=value`` settings win. Defaults, units and bounds live in
the models alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError


class StrictModel(BaseModel):
    """Frozen model that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


Model = TypeVar("Model", bound=StrictModel)


def merge(base: Mapping[str, Any], update: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings; the update wins."""
    merged = dict(base)
    for key, value in update.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def read_parameters(path: Path) -> dict[str, Any]:
    """Read the parameters of a YAML file in ROS form.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or lacks ``/**: ros__parameters:``.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"{path}: not valid YAML ({first})") from error
    try:
        parameters = document["/**"]["ros__parameters"]
    except (TypeError, KeyError) as error:
        raise InputError(f"{path}: expected '/**:' then 'ros__parameters:' at the top") from error
    if not isinstance(parameters or {}, dict):
        raise InputError(f"{path}: 'ros__parameters:' must hold names and values")
    return dict(parameters or {})


def parse_setting(setting: str) -> dict[str, Any]:
    """Turn ``a.b=1.5`` into ``{"a": {"b": 1.5}}``."""
    key, separator, text = setting.partition("=")
    parts = key.split(".")
    if not separator or not all(parts):
        raise InputError(f"--set {setting}: expected key=value, e.g. odometry.voxel=0.8")
    try:
        value: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"--set {setting}: the value is not valid YAML; quote it") from error
    for part in reversed(parts):
        value = {part: value}
    return dict(value)


def validate(model: type[Model], values: Mapping[str, Any], source: str) -> Model:
    """Validate values, turning the first complaint into one clear line."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{source}: {where}: {first['msg']}") from error


def load_config(model: type[Model], files: Sequence[Path] = (), settings: Iterable[str] = ()) -> Model:
    """Load a model from files and ``key=value`` settings, later ones winning."""
    values: dict[str, Any] = {}
    for path in files:
        values = merge(values, read_parameters(Path(path)))
    for setting in settings:
        values = merge(values, parse_setting(setting))
    source = ", ".join([*(str(p) for p in files), *settings]) or "configuration"
    return validate(model, values, source)


def config_hash(config: StrictModel) -> str:
    """Return a short hash of every resolved value."""
    text = json.dumps(config.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_config(path: Path, config: StrictModel) -> None:
    """Write a resolved configuration in ROS parameter form, readable by :func:`load_config`."""
    document = {"/**": {"ros__parameters": config.model_dump(mode="json")}}
    with whole_file(path) as temporary:
        temporary.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")

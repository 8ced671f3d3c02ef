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
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError

_MOST_YAML_NODES = 1_000_000
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 120


class _Loader(yaml.SafeLoader):
    """Safe loader that refuses aliases that unfold into more than any file of ours holds."""

    def construct_document(self, node: yaml.Node) -> Any:
        _unfolded(node, {})
        return super().construct_document(node)


def _unfolded(node: yaml.Node, known: dict[int, int]) -> int:
    """Return the number of nodes below one, aliases counted each time."""
    size = known.get(id(node))
    if size is None:
        known[id(node)] = _MOST_YAML_NODES  # met again inside itself
        inner = node.value if isinstance(node, yaml.CollectionNode) else []
        parts = [part for item in inner for part in (item if isinstance(item, tuple) else (item,))]
        size = known[id(node)] = 1 + sum(_unfolded(part, known) for part in parts)
    if size > _MOST_YAML_NODES:
        raise yaml.YAMLError("its aliases unfold without end")
    return size


def load_yaml(text: str) -> Any:
    """Return what a YAML text holds, plain values only.

    Raises
    ------
    yaml.YAMLError
        Not YAML, nested too deep, aliases without end, or a value that is none, such as a 13th month.
    """
    try:
        return yaml.load(text, _Loader)  # noqa: S506  # a SafeLoader
    except (ValueError, ArithmeticError, LookupError, TypeError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else str(error)
        raise yaml.YAMLError(reason) from error


def _yaml_fault(error: yaml.YAMLError) -> str:
    """Return the line at fault and what is wrong there."""
    mark = getattr(error, "problem_mark", None)
    said = getattr(error, "problem", None) or (str(error).splitlines() or ["empty"])[0]
    return said if mark is None else f"line {mark.line + 1}: {said}"


class StrictModel(BaseModel):
    """Frozen model that refuses unknown keys.

    ``FORMER_NAMES``: settings that were renamed, by their former names, so that a refusal names the new one.
    ``PUBLIC``: dotted names of the settings that a user has a reason to change, the others being numbers of
    the method; None where a model makes no difference (:mod:`subiaco_geo.settings`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    FORMER_NAMES: ClassVar[Mapping[str, str]] = {}
    PUBLIC: ClassVar[tuple[str, ...] | None] = None

    @model_validator(mode="before")
    @classmethod
    def _complete_groups(cls, values: Any) -> Any:
        """Let a part of a group of settings change that part alone: the rest is as in the group's default."""
        if not isinstance(values, Mapping):
            return values
        given = dict(values)
        for name, value in values.items():
            usual = cls.model_fields[name].default if name in cls.model_fields else None
            if isinstance(value, Mapping) and isinstance(usual, BaseModel):
                given[name] = merge(usual.model_dump(), value)
        return given


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
        document = load_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file; give a configuration in YAML") from error
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not valid YAML ({_yaml_fault(error)}); correct it") from error
    try:
        parameters = document["/**"]["ros__parameters"]
    except (TypeError, KeyError, IndexError) as error:
        raise InputError(f"{path}: expected '/**:' then 'ros__parameters:' at the top") from error
    if not isinstance(parameters or {}, dict):
        raise InputError(f"{path}: 'ros__parameters:' must hold names and values")
    _refuse_odd_names(parameters or {}, str(path))
    return dict(parameters or {})


def _refuse_odd_names(values: Mapping[Any, Any], source: str) -> None:
    """Refuse names that YAML takes for numbers, truth values or nothing."""
    for name, value in values.items():
        if not isinstance(name, str):
            raise InputError(f"{source}: {name!r} is no name of a setting; correct or remove it")
        if isinstance(value, Mapping):
            _refuse_odd_names(value, source)


def parse_setting(setting: str) -> dict[str, Any]:
    """Turn ``a.b=1.5`` into ``{"a": {"b": 1.5}}``."""
    key, separator, text = setting.partition("=")
    parts = key.split(".")
    if not separator or not all(parts):
        raise InputError(f"--set {setting}: expected key=value, e.g. odometry.voxel=0.8")
    try:
        value: Any = load_yaml(text)
    except yaml.YAMLError as error:
        raise InputError(f"--set {setting}: the value is not valid YAML; quote it") from error
    for part in reversed(parts):
        value = {part: value}
    _refuse_odd_names(value, f"--set {setting}")
    return dict(value)


def _slice_of(model: type[BaseModel], path: Sequence[int | str]) -> type[BaseModel] | None:
    """Return the model of a slice of a configuration, None where the path leads to none."""
    for part in path:
        field = model.model_fields.get(str(part))
        inner = None if field is None else field.annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return None
        model = inner
    return model


def _complaint(model: type[BaseModel], error: ValidationError) -> tuple[tuple[int | str, ...], str]:
    """Return where the first fault lies and what to do about it, in one line."""
    first = error.errors()[0]
    place = first["loc"]
    where = ".".join(str(part) for part in place)
    if first["type"] != "extra_forbidden":
        message = first["msg"].removeprefix("Value error, ")
        return place, " ".join(f"{where}: {message}, got {_SHORT.repr(first['input'])}".split())
    held, name = _slice_of(model, place[:-1]), str(place[-1])
    if held is not None and issubclass(held, StrictModel) and name in held.FORMER_NAMES:
        return place, f"{where}: no such setting; it is called {held.FORMER_NAMES[name]} now"
    known = [] if held is None else sorted(held.model_fields)
    close = get_close_matches(name, known, n=1)
    advice = f"did you mean {close[0]}?" if close else f"known are {', '.join(known) or 'none'}"
    return place, f"{where}: no such setting; {advice}"


def validate(model: type[Model], values: Mapping[str, Any], source: str) -> Model:
    """Validate values, turning the first complaint into one clear line."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise InputError(f"{source}: {_complaint(model, error)[1]}") from error


def _holds(values: object, place: Sequence[int | str]) -> bool:
    """Tell whether nested values reach a place, or stop at a value on the way to it."""
    for part in place:
        if not isinstance(values, Mapping):
            return True
        if part not in values:
            return False
        values = values[part]
    return True


def load_config(
    model: type[Model],
    files: Sequence[Path] = (),
    settings: Iterable[str] = (),
    options: Mapping[str, str] | None = None,
) -> Model:
    """Load a model from files, options and ``key=value`` settings, later ones winning.

    ``options`` are further settings, by the words of the command that errors name.

    Raises
    ------
    InputError
        Names the file or setting at fault, the field, and what it may be.
    """
    sources = [(str(path), read_parameters(Path(path))) for path in files]
    sources += [(words, parse_setting(setting)) for words, setting in (options or {}).items()]
    sources += [(f"--set {setting}", parse_setting(setting)) for setting in settings]
    values: dict[str, Any] = {}
    for _, given in sources:
        values = merge(values, given)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        place, complaint = _complaint(model, error)
        guilty = [name for name, given in sources if _holds(given, place)]
        raise InputError(f"{guilty[-1] if guilty else 'configuration'}: {complaint}") from error


def config_hash(config: StrictModel) -> str:
    """Return a short hash of every resolved value."""
    text = json.dumps(config.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_config(path: Path, config: StrictModel) -> None:
    """Write a resolved configuration in ROS parameter form, readable by :func:`load_config`."""
    document = {"/**": {"ros__parameters": config.model_dump(mode="json")}}
    with whole_file(path) as temporary:
        temporary.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")

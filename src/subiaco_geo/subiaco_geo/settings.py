"""Settings by their dotted names: the public ones, and the numbers of the method.

A setting is public where a user has a reason to change it: sensors, topics, coordinate systems, what counts
as a change. All others are numbers of the method. They stand in the same models, can be changed for research,
and are written out with every result, with the version of the method and their hash.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from subiaco_geo.config import StrictModel
from subiaco_geo.work.tasks import fingerprint

#: Raised with every change of a number or a rule of the method. ``config/method_versions.yaml`` holds the
#: hashes of its numbers, and a test fails where they changed and the version did not.
METHOD_VERSION = "1.51"


def setting_fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield dotted name and field of every setting of a model, nested ones included."""
    for name, field in model.model_fields.items():
        inner = inner_model(field.annotation)
        if inner is None:
            yield f"{prefix}{name}", field
        else:
            yield from setting_fields(inner, f"{prefix}{name}.")


def inner_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model that a field holds, or may hold; None for a plain value."""
    union = get_origin(annotation) in (Union, UnionType)
    kinds = get_args(annotation) if union else (annotation,)
    models = (kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel))
    return next(models, None)


def setting_values(config: StrictModel) -> dict[str, Any]:
    """Return the values of all settings by dotted name, plain and as they are written to files."""
    return _flat(config.model_dump(mode="json"), type(config), "")


def _flat(values: Mapping[str, Any], model: type[BaseModel], prefix: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in values.items():
        inner = inner_model(model.model_fields[name].annotation)
        if inner is not None and isinstance(value, Mapping):
            found |= _flat(value, inner, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


def departures(model: BaseModel, usual: BaseModel | None = None) -> dict[str, Any]:
    """Return what departs from the defaults, nested, plain and ready to be validated again.

    Parameters
    ----------
    model : BaseModel
    usual : BaseModel, optional
        The model with which it is compared; the defaults of its fields where absent.
    """
    plain, found = model.model_dump(mode="json"), {}
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        known = field.get_default(call_default_factory=True) if usual is None else getattr(usual, name)
        if isinstance(value, BaseModel) and isinstance(known, type(value)):
            own: Any = departures(value, known)
            if own:
                found[name] = own
        elif value != known:
            found[name] = plain[name]
    return found


def is_public(model: type[StrictModel], name: str) -> bool:
    """Tell whether a setting, by its dotted name in a model, is public."""
    return model.PUBLIC is None or name in model.PUBLIC


def method_numbers(config: StrictModel) -> dict[str, Any]:
    """Return the settings that are numbers of the method, by dotted name."""
    values = setting_values(config)
    return {name: value for name, value in values.items() if not is_public(type(config), name)}


def method_statement(config: StrictModel, constants: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return what identifies the method of a result.

    Parameters
    ----------
    config : StrictModel
        As resolved.
    constants : mapping, optional
        Numbers of the method that are no settings, by dotted name.

    Returns
    -------
    dict
        ``version``; ``hash`` of all numbers; ``departures``, the numbers that are not at their defaults;
        ``constants`` as given. The other numbers stand in the ``config.yaml`` of the result.
    """
    numbers = method_numbers(config)
    usual = method_numbers(type(config)())
    return {
        "version": METHOD_VERSION,
        "hash": fingerprint({**numbers, **(constants or {})})[:16],
        "departures": {name: value for name, value in numbers.items() if value != usual.get(name)},
        **({} if constants is None else {"constants": dict(constants)}),
    }

"""Results of stages: any frozen dataclass of arrays and plain values, stored and loaded by one routine.

Fields that are arrays become arrays of the same name; fields that are dataclasses with arrays become arrays
below ``name.``; all other fields (numbers, texts, enumerations, tuples and dataclasses of these) are kept as
JSON. A field that is None is left out. A loaded result reads a field when it is asked for.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from subiaco_geo.work.store import Array, Arrays

Result = TypeVar("Result")
_PLAIN = "plain"  # array with the fields that are no arrays, as JSON
_SOURCE = "_stored"  # attribute of a loaded result: arrays and prefix that the fields are read from
_CODECS: dict[type, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {}


def register_codec(kind: type, to_plain: Callable[[Any], Any], from_plain: Callable[[Any], Any]) -> None:
    """Tell how values of a foreign type, such as geometries, become what JSON holds, and back."""
    _CODECS[kind] = (to_plain, from_plain)


def pack(result: Any) -> dict[str, Array]:
    """Return a result as arrays by name.

    Parameters
    ----------
    result : dataclass instance

    Raises
    ------
    TypeError
        It is no dataclass.
    """
    if not is_dataclass(result) or isinstance(result, type):
        raise TypeError(f"{type(result).__name__}: the result of a stage is a dataclass")
    arrays: dict[str, Array] = {}
    _pack(result, "", arrays)
    return arrays


def unpack(kind: type[Result], arrays: Arrays) -> Result:
    """Return the result of a type that :func:`pack` took apart; a field is read when it is asked for."""
    found: Result = _open(kind, arrays, "")
    return found


@cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the types of the fields of a dataclass, without ``None``."""
    hints = get_type_hints(kind)
    return {f.name: _required(hints[f.name]) for f in fields(kind)}


@cache
def _required(hint: Any) -> Any:
    """Return a type without ``None``, and what an alias or a variable of a type stands for."""
    if get_origin(hint) in (Union, UnionType):
        some = [part for part in get_args(hint) if part is not NoneType]
        return some[0] if len(some) == 1 else hint
    return hint


@cache
def _is_array(hint: Any) -> bool:
    return (get_origin(hint) or hint) is np.ndarray


@cache
def _is_result(hint: Any) -> bool:
    """Whether a type is a dataclass that holds arrays, at any depth."""
    if not (isinstance(hint, type) and is_dataclass(hint)):
        return False
    return any(_is_array(inner) or _is_result(inner) for inner in _hints(hint).values())


def _pack(result: Any, prefix: str, arrays: dict[str, Array]) -> None:
    plain: dict[str, Any] = {}
    hints = _hints(_declared(type(result)))
    for name, hint in hints.items():
        value = getattr(result, name)
        if value is None:
            continue
        if _is_array(hint):
            arrays[prefix + name] = np.asarray(value)
        elif _is_result(hint):
            _pack(value, f"{prefix}{name}.", arrays)
        else:
            plain[name] = _to_plain(value)
    if plain:
        arrays[prefix + _PLAIN] = np.array(json.dumps(plain))


def _to_plain(value: Any) -> Any:
    for kind, (encode, _) in _CODECS.items():
        if isinstance(value, kind):
            return encode(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {name: _to_plain(getattr(value, name)) for name in _hints(_declared(type(value)))}
    if isinstance(value, Mapping):
        return {str(name): _to_plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_to_plain(inner) for inner in value]
    return value.item() if isinstance(value, np.generic) else value


def _from_plain(hint: Any, plain: Any) -> Any:
    hint, origin = _required(hint), get_origin(_required(hint))
    if plain is None:
        return None
    if origin is tuple:
        inner = get_args(hint)
        if inner[-1] is Ellipsis:
            return tuple(_from_plain(inner[0], value) for value in plain)
        return tuple(_from_plain(own, value) for own, value in zip(inner, plain, strict=True))
    return _of_class(hint, plain) if isinstance(hint, type) else plain


def _of_class(kind: type, plain: Any) -> Any:
    """Return a dataclass, an enumeration, a value with a codec, or the plain value itself."""
    if is_dataclass(kind):
        hints = _hints(kind)
        return kind(**{name: _from_plain(hints[name], value) for name, value in plain.items()})
    if issubclass(kind, Enum):
        return kind(plain)
    return _CODECS[kind][1](plain) if kind in _CODECS else plain


class _Loaded:
    """Base of loaded results: a field that was not read yet is read from where the result is stored."""

    def __getattr__(self, name: str) -> Any:
        hints = _hints(_declared(type(self)))
        if name not in hints or _SOURCE not in self.__dict__:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        arrays, prefix = self.__dict__[_SOURCE]
        self.__dict__[name] = value = _read(name, hints[name], arrays, prefix)
        return value

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        """Pickle the result that this stands for, with all its fields."""
        kind = _declared(type(self))
        return kind, tuple(getattr(self, name) for name in _hints(kind))


@cache
def _loaded(kind: type) -> type:
    """Return the class of loaded results of a type."""
    return type(kind.__name__, (_Loaded, kind), {"__module__": kind.__module__})


def _declared(kind: type) -> type:
    """Return the type that was declared, of a loaded result too."""
    return kind.__bases__[1] if issubclass(kind, _Loaded) else kind


def _open(kind: Any, arrays: Arrays, prefix: str) -> Any:
    found: Any = object.__new__(_loaded(kind))
    found.__dict__[_SOURCE] = (arrays, prefix)
    hints = _hints(kind)
    for own in fields(kind):
        if own.default is not MISSING:  # the default would hide what is stored
            found.__dict__[own.name] = _read(own.name, hints[own.name], arrays, prefix)
    return found


def _read(name: str, hint: Any, arrays: Arrays, prefix: str) -> Any:
    """Read a field; None where it was left out."""
    if _is_array(hint):
        return arrays.get(prefix + name)
    if _is_result(hint):
        inner = f"{prefix}{name}."
        return _open(hint, arrays, inner) if any(key.startswith(inner) for key in arrays) else None
    if prefix + _PLAIN not in arrays:
        return None
    plain = json.loads(str(arrays[prefix + _PLAIN]))
    return _from_plain(hint, plain[name]) if name in plain else None

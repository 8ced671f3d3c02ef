"""The page of interfaces: messages, services and the action, from the files that define them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from reference_pages.markdown import GENERATED, cell, code, table

FOLDER = Path(__file__).resolve().parents[2] / "src/subiaco_msgs"
_FIELD = re.compile(r"^(?P<type>[\w/]+(?:\[[^\]]*\])?)\s+(?P<name>\w+)\s*(?:#\s*(?P<text>.*))?$")
_CONSTANT = re.compile(
    r"^(?P<type>\w+)\s+(?P<name>[A-Z]\w*)\s*=\s*(?P<value>[^#]*?)\s*(?:#\s*(?P<text>.*))?$"
)
_PARTS = {"msg": ("Fields",), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
_TITLES = {"msg": "Messages", "srv": "Services", "action": "Actions"}


@dataclass(frozen=True)
class Field:
    """One field of an interface: its ROS type, its name and its meaning."""

    type: str
    name: str
    text: str


@dataclass(frozen=True)
class Interface:
    """A message, service or action: what it is for, and its fields by part."""

    name: str
    kind: str
    text: str
    parts: tuple[tuple[Field, ...], ...]
    constants: tuple[tuple[Field, str], ...] = ()


def interfaces() -> Iterator[Interface]:
    """Yield every interface of ``subiaco_msgs``."""
    for kind in _PARTS:
        for path in sorted((FOLDER / kind).glob(f"*.{kind}")):
            yield read(path, kind)


def read(path: Path, kind: str) -> Interface:
    """Return what a definition file says; comments behind and below a field are its meaning."""
    top: list[str] = []
    parts: list[list[Field]] = [[]]
    constants: list[tuple[Field, str]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        stripped = line.strip()
        found, constant = _FIELD.match(stripped), _CONSTANT.match(stripped)
        if constant:
            constants.append(
                (Field(constant["type"], constant["name"], constant["text"] or ""), constant["value"])
            )
        elif stripped == "---":
            parts.append([])
        elif found:
            parts[-1].append(Field(found["type"], found["name"], found["text"] or ""))
        elif stripped.startswith("#") and parts[-1]:  # a meaning that goes on in the next line
            last = parts[-1].pop()
            parts[-1].append(Field(last.type, last.name, f"{last.text} {stripped[1:].strip()}"))
        elif stripped.startswith("#"):
            top.append(stripped[1:].strip())
    return Interface(path.stem, kind, " ".join(top), tuple(tuple(part) for part in parts), tuple(constants))


def page() -> str:
    """Return the page."""
    parts = [
        "# Messages, services and actions",
        GENERATED,
        "All interfaces are in the package `subiaco_msgs`.",
    ]
    kind = ""
    for interface in interfaces():
        if interface.kind != kind:
            kind = interface.kind
            parts.append(f"## {_TITLES[kind]}")
        parts += [f"### subiaco_msgs/{kind}/{interface.name}", interface.text]
        for title, fields in zip(_PARTS[kind], interface.parts, strict=True):
            rows = [(code(f.name), code(f.type), cell(f.text)) for f in fields]
            if kind != "msg":
                parts.append(f"**{title}**" + ("" if rows else ": no fields."))
            if rows:
                parts.append(table(("field", "type", "meaning"), rows))
        if interface.constants:
            values = [(code(f.name), code(v), cell(f.text)) for f, v in interface.constants]
            parts += ["**Constants**", table(("name", "value", "meaning"), values)]
    return "\n\n".join(parts) + "\n"

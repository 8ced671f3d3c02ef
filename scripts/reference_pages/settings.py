"""The pages of settings: every field of every configuration model."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import PurePath
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from reference_pages.markdown import GENERATED, cell, code, table
from subiaco_geo.config import StrictModel
from subiaco_geo.settings import is_public, setting_fields

_UNIT = re.compile(r"\s*\[([^\]]+)\]")
_NAMES: dict[Any, str] = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    NoneType: "none",
}
_BOUNDS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}

_FORM = """A setting has a dotted name. Give it on the command line with `--set name=value`, or in a YAML
file with `--config FILE`. The file has the form of ROS parameters, so that commands and nodes read the
same file:

```yaml
/**:
  ros__parameters:
    odometry:
      voxel: 1.0
```

`subiaco config map`, `subiaco config change` and `subiaco config record` print the public settings in this
form, with `--all` every setting. Later files win over earlier ones, and `--set` wins over files.
`config.yaml` in every map and change directory lists all settings of that run."""


@dataclass(frozen=True)
class Setting:
    """One setting: its dotted name and what a reader of the reference needs."""

    name: str
    public: bool
    type: str
    unit: str
    default: str
    bounds: str
    description: str


def models() -> dict[str, tuple[str, type[StrictModel], str]]:
    """Return the models of the commands by page name, with a title and where each is used."""
    from subiaco_change.config import ChangeConfig
    from subiaco_evaluation.config import BaselineConfig
    from subiaco_evaluation.injection.calibrate import MapCalibrationConfig
    from subiaco_evaluation.learned.config import TrainingConfig
    from subiaco_evaluation.scoring import EvaluationConfig
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.recording.config import RecordingConfig
    from subiaco_sim.config import SimulationConfig

    return {
        "settings-mapping": ("mapping", MappingConfig, "`subiaco map`, `import`, `inspect`, `graph`"),
        "settings-change": ("the comparison", ChangeConfig, "`subiaco change`, `graph change`, `ablate`"),
        "settings-recording": ("recording", RecordingConfig, "`subiaco record`, `graph live`"),
        "settings-calibration": ("injection", MapCalibrationConfig, "`subiaco calibrate`, `inject`"),
        "settings-evaluation": ("evaluation", EvaluationConfig, "`subiaco evaluate` in Python"),
        "settings-baselines": ("the simple methods", BaselineConfig, "`subiaco baseline`"),
        "settings-training": ("the training of learned methods", TrainingConfig, "`subiaco train`"),
        "settings-simulation": ("the simulator", SimulationConfig, "`subiaco simulate`"),
    }  # fmt: skip


def settings(model: type[StrictModel]) -> Iterator[Setting]:
    """Yield the settings of a model, those of models within it by their dotted names."""
    for name, field in setting_fields(model):
        yield _setting(name, field, public=model.PUBLIC is not None and is_public(model, name))


def _setting(name: str, field: FieldInfo, *, public: bool) -> Setting:
    text = field.description or ""
    units = _UNIT.findall(text)
    return Setting(
        name,
        public,
        type_text(field.annotation),
        units[0] if units else "",
        _default(field),
        _bounds(field),
        _UNIT.sub("", text, count=1),
    )


def type_text(annotation: Any) -> str:
    """Return a type as a reader knows it."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        text = ", ".join(repr(value) for value in inner)
    elif origin in (Union, UnionType):
        text = " or ".join(type_text(kind) for kind in inner)
    elif origin in (list, tuple):
        text = f"list of {type_text(inner[0])}"
    elif origin is dict:
        text = f"mapping to {type_text(inner[-1])}"
    else:
        text = _plain_type(annotation)
    return text


def _plain_type(annotation: Any) -> str:
    """Return the name of a type without parts."""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return ", ".join(str(value.value) for value in annotation)
    if isinstance(annotation, type) and issubclass(annotation, PurePath):
        return "path"
    return _NAMES.get(annotation) or str(getattr(annotation, "__name__", annotation))


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return "required"
    if isinstance(value, StrictModel):
        return ""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    if isinstance(value, tuple):
        value = list(value)
    return str(value.value) if isinstance(value, Enum) else str(value)


def _bounds(field: FieldInfo) -> str:
    found = []
    for rule in field.metadata:
        found += [
            f"{sign} {getattr(rule, name)}"
            for name, sign in _BOUNDS.items()
            if getattr(rule, name, None) is not None
        ]
        if getattr(rule, "pattern", None):
            found.append(f"form {rule.pattern}")
    return ", ".join(found)


def pages() -> dict[str, str]:
    """Return the text of every page of settings by its name."""
    return {"settings": _overview()} | {name: _page(*entry) for name, entry in models().items()}


def _overview() -> str:
    rows = [
        (f"[{title}]({name}.md)", used, str(sum(1 for _ in settings(model))))
        for name, (title, model, used) in models().items()
    ]
    parts = [
        "# Settings",
        GENERATED,
        _FORM,
        table(("settings of", "commands", "number"), rows),
    ]
    return "\n\n".join(parts) + "\n"


def _page(title: str, model: type[StrictModel], used: str) -> str:
    found = list(settings(model))
    parts = [f"# Settings of {title}", GENERATED, f"Used by: {used}."]
    public = [setting for setting in found if setting.public]
    if public:
        parts += ["## Public settings", "These settings are meant to be changed by users.", _table(public)]
    groups: dict[str, list[Setting]] = {}
    for setting in found:
        if not setting.public:
            groups.setdefault(setting.name.split(".")[0] if "." in setting.name else "general", []).append(
                setting
            )
    for group in sorted(groups, key=lambda name: (name != "general", name)):
        parts += [f"## {group}", _table(groups[group])]
    return "\n\n".join(parts) + "\n"


def _table(found: list[Setting]) -> str:
    rows = (
        (code(s.name), cell(s.description), s.unit, cell(s.type), code(s.default), cell(s.bounds))
        for s in found
    )
    return table(("setting", "meaning", "unit", "type", "default", "bounds"), rows)

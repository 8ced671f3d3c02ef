"""The verb that shows settings: config."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import typer
import yaml

from subiaco_bringup.cli.options import AsJson, ConfigFiles, Settings, print_json
from subiaco_bringup.defaults import config_files
from subiaco_geo.config import StrictModel, load_config
from subiaco_geo.settings import is_public, setting_fields, setting_values


class SettingsJob(StrEnum):
    """A job that has settings."""

    MAP = "map"
    CHANGE = "change"
    RECORD = "record"


def _model_of(job: SettingsJob) -> tuple[type[StrictModel], str]:
    """Return the model of a job and the name of its shipped files."""
    from subiaco_change.config import ChangeConfig
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.recording.config import RecordingConfig

    models: dict[SettingsJob, tuple[type[StrictModel], str]] = {
        SettingsJob.MAP: (MappingConfig, "mapping"),
        SettingsJob.CHANGE: (ChangeConfig, "change"),
        SettingsJob.RECORD: (RecordingConfig, "record"),
    }
    return models[job]


@dataclass(frozen=True)
class Shown:
    """A setting as it is shown; not ``given`` where its group is left out, as an unknown sensor pose is."""

    description: str
    value: object
    given: bool


def shown_settings(config: StrictModel, *, every: bool) -> dict[str, Shown]:
    """Return the settings by dotted name: the public ones, or every one."""
    model, values = type(config), setting_values(config)
    fields = {name: field for name, field in setting_fields(model) if every or is_public(model, name)}
    return {
        name: Shown(field.description or "", values.get(name, field.default), name in values)
        for name, field in fields.items()
    }


def as_yaml(settings: dict[str, Shown]) -> str:
    """Return settings as a file for ``--config``, each below its description."""
    lines = ["/**:", "  ros__parameters:"]
    before: list[str] = []
    for name, shown in settings.items():
        *groups, last = name.split(".")
        depth = _shared(before, groups)
        lines += [f"{'  ' * (k + 2)}{groups[k]}:" for k in range(depth, len(groups))]
        indent = "  " * (len(groups) + 2)
        lines += [
            f"{indent}# {shown.description}",
            f"{indent}{'' if shown.given else '# '}{last}: {_text(shown.value)}",
        ]
        before = groups
    return "\n".join(lines) + "\n"


def _shared(before: list[str], groups: list[str]) -> int:
    """Count the outer groups that two settings share."""
    same = [old == new for old, new in zip(before, groups, strict=False)]
    return [*same, False].index(False)


def _text(value: object) -> str:
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(plain, default_flow_style=True, width=10_000).removesuffix("...\n").strip()


def config(
    job: Annotated[SettingsJob, typer.Argument(metavar="JOB", help="map, change or record.")],
    every: Annotated[
        bool,
        typer.Option("--all", help="Show the numbers of the method too, which only research has to change."),
    ] = False,
    files: ConfigFiles = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Show the settings of a job that you may have a reason to change, with their values.

    What is printed is a file for --config.

    Example: subiaco config change > my.yaml
    """
    model, name = _model_of(job)
    shown = shown_settings(
        load_config(model, config_files(name, tuple(files or ())), settings or []), every=every
    )
    if as_json:
        print_json({name: setting.value for name, setting in shown.items()})
    else:
        typer.echo(as_yaml(shown), nl=False)


def register(app: typer.Typer) -> None:
    """Add this verb to the command."""
    app.command("config", short_help="Show the settings of a job.")(config)

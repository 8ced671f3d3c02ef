"""What every output file holds, read from ``output_files.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml


@dataclass(frozen=True)
class File:
    """An output file: its name, what it holds, and its columns, fields, keys or bands with their meaning."""

    name: str
    text: str
    columns: Mapping[str, str] = field(default_factory=dict)
    kind: str = "column"


@dataclass(frozen=True)
class Folder:
    """A directory that a command writes."""

    title: str
    command: str
    text: str
    files: tuple[File, ...]


def folders() -> tuple[Folder, ...]:
    """Return the directories that commands write."""
    found = yaml.safe_load(Path(__file__).with_name("output_files.yaml").read_text(encoding="utf-8"))
    return tuple(Folder(**{**one, "files": tuple(File(**file) for file in one["files"])}) for one in found)

"""Serious findings of a change run, said last on the terminal: what is said early scrolls away."""

from __future__ import annotations

import json
from pathlib import Path

import typer


def say_findings(directory: Path) -> None:
    """Say the serious findings of a change directory in red, also where only errors are asked for."""
    run = json.loads((directory / "run.json").read_text(encoding="utf-8"))
    serious = [found for found in run.get("findings", []) if found["severity"] == "serious"]
    for found in serious:
        typer.secho(f"{directory}: {found['sentence']} {found['remedy']}", err=True, fg="red")

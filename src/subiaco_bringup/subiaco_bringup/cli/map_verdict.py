"""The verdict on a map that has been written: on the terminal, and as the exit code."""

from __future__ import annotations

import json
from pathlib import Path

import typer
import yaml

from subiaco_bringup.cli.options import say

CONTRADICTED = 3


def end_with_verdict(output: Path, *, quiet: bool) -> None:
    """Say the verdict of the quality page; end with 3 where the map's own fixes contradict it.

    Parameters
    ----------
    output : Path
        Map directory.
    quiet : bool
        Say only what contradicts.

    Raises
    ------
    typer.Exit
        The fixes contradict the map.
    """
    figures, manifest = output / "quality.json", output / "manifest.yaml"
    verdict = json.loads(figures.read_text(encoding="utf-8"))["verdict"] if figures.is_file() else {}
    facts = yaml.safe_load(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
    contradicted = bool(facts.get("gnss_contradicts"))
    if verdict:
        say(verdict["sentence"], quiet=quiet)
    if contradicted:
        wrong = verdict["wrong"][0] if verdict.get("wrong") else "most fixes are farther off than they state"
        say(f"{output}: the map's own fixes contradict it ({wrong})")
        raise typer.Exit(CONTRADICTED)

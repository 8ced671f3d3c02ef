"""Options that several verbs share."""

from __future__ import annotations

import gc
import json
import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

ConfigFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--config", metavar="FILE", help="YAML of settings (ROS parameter form); repeatable, later wins."
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="One setting by its dotted name; repeatable, wins over files. "
        "'subiaco config map' and 'subiaco config change' list the usual names, with --all every name.",
    ),
]
Output = Annotated[
    Path, typer.Option("-o", "--output", metavar="DIR", help="Directory to write; it must not exist yet.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier output of this command.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say more; show the traceback of a fault.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say only errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


@contextmanager
def no_collection() -> Iterator[None]:
    """Look for no garbage meanwhile: loading many modules takes a tenth longer with the search."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def set_up_logging(verbose: bool, quiet: bool) -> None:
    """Send log lines to stderr at the level the user asked for."""
    level = logging.DEBUG if verbose else logging.ERROR if quiet else logging.WARNING
    logging.basicConfig(
        level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr
    )
    for name in ("geo", "sim", "mapping", "change", "evaluation", "report", "ros", "bringup"):
        logging.getLogger(f"subiaco_{name}").setLevel(level)


def say(text: str, *, quiet: bool = False) -> None:
    """Write one line for people, on stderr: stdout is for results that were asked for."""
    if not quiet:
        sys.stderr.write(text + "\n")


def print_json(value: Mapping[str, Any]) -> None:
    """Print a result on stdout."""
    sys.stdout.write(json.dumps(value, indent=2, default=str) + "\n")

"""Entry point of ``subiaco``: verbs, help that teaches, exit codes by contract."""

from __future__ import annotations

import errno
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import typer

from subiaco_bringup.cli import (
    commands_calibration,
    commands_change,
    commands_config,
    commands_delivery,
    commands_evaluation,
    commands_graph,
    commands_record,
    commands_survey,
)
from subiaco_geo import __version__
from subiaco_geo.disk import is_disk_full
from subiaco_geo.errors import SubiacoError
from subiaco_geo.signals import signals_interrupt

EPILOG = """\b
A survey in four commands:
  subiaco simulate bags/demo
  subiaco map bags/demo/before -o out/before
  subiaco map bags/demo/after -o out/after
  subiaco change out/before out/after -o out/change

'subiaco VERB --help' shows an example of each.

\b
Exit codes: 0 done, 2 bad input or usage, 3 a registration that failed or
cannot be trusted, or a map that its own fixes contradict, 1 a fault of ours,
130 interrupted, 143 ended by SIGTERM.
"""
#: What a file system refuses for reasons that are the user's to mend.
_DISK_REFUSALS = frozenset(
    {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR, errno.ENAMETOOLONG}
)
_INTERRUPTED, _TERMINATED = 130, 143

app = typer.Typer(
    name="subiaco",
    help="Build georeferenced 3D city maps from LiDAR drives, and find what changed between two of them.",
    epilog=EPILOG,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


def _print_version(asked: bool) -> None:
    if asked:
        sys.stdout.write(f"subiaco {__version__}\n")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end."),
    ] = False,
) -> None:
    """Build georeferenced 3D city maps from LiDAR drives, and find what changed between two of them."""


commands_survey.register(app)
commands_change.register(app)
commands_delivery.register(app)
commands_evaluation.register(app)
commands_calibration.register(app)
commands_graph.register(app)
commands_record.register(app)
commands_config.register(app)


def _report(message: str) -> None:
    first, *_ = message.splitlines() or [""]
    sys.stderr.write(f"subiaco: {first}\n")


def _report_usage(message: str, command: str) -> None:
    if message.startswith("Usage:"):  # a verb group called without a verb
        sys.stderr.write(message + "\n")
    else:
        _report(f"{' '.join(message.split())} (see '{command} --help')")


def _output_of(words: Sequence[str]) -> str:
    """Return the output that a command names, else what to call it."""
    for option in ("-o", "--output"):
        if option in words[:-1]:
            return words[words.index(option) + 1]
    return "the output"


def _report_unexpected(error: Exception, words: Sequence[str]) -> int:
    """Report a fault of ours, or rights, room and paths that the file system refused: the user's to mend."""
    if is_disk_full(error):
        _report(f"{_output_of(words)}: the disk is full; make room and give the same command again")
        return 2
    if isinstance(error, OSError) and error.errno in _DISK_REFUSALS and error.filename is not None:
        reason = (error.strerror or "refused").lower()
        _report(f"{error.filename}: {reason}; choose another place, or make room or rights there")
        return 2
    reason = " ".join(str(error).split())
    _report(f"fault: {type(error).__name__}: {reason} (run again with -v for the traceback)")
    return 1


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after ``subiaco``; those of the process where absent.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    verbose = "-v" in words or "--verbose" in words
    came: list[int] = []
    try:
        with signals_interrupt() as came:
            outcome = app(args=words, prog_name="subiaco", standalone_mode=False)
    except SubiacoError as error:
        if verbose:
            traceback.print_exc()
        _report(str(error))
        return error.exit_code
    except typer.TyperException as error:
        _report_usage(error.format_message(), getattr(getattr(error, "ctx", None), "command_path", "subiaco"))
        return 2
    except (KeyboardInterrupt, typer.Abort):
        outcome = _INTERRUPTED
    except Exception as error:  # noqa: BLE001 - the border: anything else is a fault of ours
        if verbose:
            traceback.print_exc()
        return _report_unexpected(error, words)
    if outcome == _INTERRUPTED:  # typer turns Ctrl-C into this code without a word
        _report("interrupted; no output was written")
        return _TERMINATED if signal.SIGTERM in came else _INTERRUPTED
    return int(outcome or 0)


def main() -> None:
    """Console entry point."""
    sys.exit(run())


if __name__ == "__main__":
    main()

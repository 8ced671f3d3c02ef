"""The page of commands: every verb with its text, arguments and options, as ``--help`` shows them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from typer.main import get_command

from reference_pages.markdown import GENERATED, cell, code, table

EXIT_CODES = {
    0: "Done.",
    1: "A fault of the software. Run the command again with `-v` for the traceback.",
    2: "Bad input or usage. One line names the file, topic or field, and the remedy.",
    3: "A registration failed or cannot be trusted, or the GNSS fixes contradict the map.",
    130: "Interrupted by Ctrl-C.",
    143: "Interrupted by SIGTERM.",
}
#: Options that every verb has where it applies, described once.
_HELP = "--help"


def verbs() -> Iterator[tuple[str, Any]]:
    """Yield every command with its full name, groups without themselves."""
    from subiaco_bringup.cli.main import app

    yield from _walk(get_command(app), "subiaco")


def _walk(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    if not hasattr(command, "commands"):
        yield name, command
        return
    for word, inner in command.commands.items():
        yield from _walk(inner, f"{name} {word}")


def page() -> str:
    """Return the page."""
    parts = [
        "# Commands",
        GENERATED,
        "Every command is a verb of `subiaco`. `subiaco VERB --help` shows the same text on a terminal.",
        "`subiaco --version` prints the version.",
        "## Exit codes",
        table(("code", "meaning"), ((code(number), text) for number, text in EXIT_CODES.items())),
        *(_verb(name, command) for name, command in verbs() if not command.hidden),
    ]
    return "\n\n".join(parts) + "\n"


def _verb(name: str, command: Any) -> str:
    shown = [p for p in command.params if not getattr(p, "hidden", False) and _HELP not in p.opts]
    arguments = [p for p in shown if not p.opts[0].startswith("-")]
    usage = " ".join([name, *(p.metavar or p.name.upper() for p in arguments), "[OPTIONS]"])
    rows = [(_names(p), cell(getattr(p, "help", None) or ""), _default(p)) for p in shown]
    text = (command.help or "").replace("\b", "")
    return "\n\n".join(
        [
            f"## {name}",
            f"```text\n{usage}\n```",
            "\n\n".join(_paragraph(part) for part in text.strip().split("\n\n")),
            table(("argument or option", "meaning", "default"), rows),
        ]
    )


def _paragraph(text: str) -> str:
    """Return one paragraph of a help text; an example becomes a block of code."""
    first, _, rest = text.partition(":")
    if first not in ("Example", "Examples"):
        return text
    lines = [line.strip() for line in rest.strip().splitlines() if line.strip()]
    return f"{first}:\n\n```bash\n" + "\n".join(lines) + "\n```"


def _names(parameter: Any) -> str:
    if not parameter.opts[0].startswith("-"):
        return code(parameter.metavar or parameter.name.upper())
    names = ", ".join(code(option) for option in [*parameter.opts, *parameter.secondary_opts])
    return names if parameter.is_flag or not parameter.metavar else f"{names} {code(parameter.metavar)}"


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    if value is None or value is False or callable(value):
        return ""
    return "repeatable" if parameter.multiple and not value else code(value)

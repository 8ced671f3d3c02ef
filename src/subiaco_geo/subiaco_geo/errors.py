"""The exceptions of the project; the command line turns them into exit codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SubiacoError(Exception):
    """Root of every error raised on purpose.

    The message is one line that names the file, topic or field at fault and
    the remedy.
    """

    exit_code = 1


class InputError(SubiacoError):
    """The user's input or usage is at fault (exit code 2)."""

    exit_code = 2


class RegistrationError(SubiacoError):
    """Two epochs could not be registered, or not to be trusted (exit code 3)."""

    exit_code = 3


def reason_of(error: Exception) -> str:
    """Return why a file could not be read in words for its user: the system's reason, or what it is not."""
    if isinstance(error, OSError):
        return (error.strerror or str(error) or "refused").lower()
    if isinstance(error, UnicodeDecodeError):
        return "not a text file"
    return " ".join(str(error).split())


@contextmanager
def errors_name(path: Path) -> Iterator[None]:
    """Let input errors that are raised inside name the file that is read there, where they do not yet."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error

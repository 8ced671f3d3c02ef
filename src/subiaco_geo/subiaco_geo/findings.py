"""What speaks against a result: one list that the command line, ``run.json``, report and summary show."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

#: ``serious``: the result is probably not what was asked for; ``warning``: it is weaker than it looks;
#: ``note``: an assumption or an operation that a reader must know.
Severity = Literal["serious", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("serious", "warning", "note")
_LEVELS: dict[Severity, int] = {"serious": logging.WARNING, "warning": logging.WARNING, "note": logging.INFO}


@dataclass(frozen=True)
class Finding:
    """One thing that speaks against a result.

    Parameters
    ----------
    code : str
        Name for programs, such as ``epochs_swapped``.
    severity : {"serious", "warning", "note"}
    sentence : str
        What was found, with its values.
    remedy : str
        What to do about it; empty where nothing can be done.
    """

    code: str
    severity: Severity
    sentence: str
    remedy: str = ""

    @property
    def text(self) -> str:
        """Sentence and remedy in one line."""
        return f"{self.sentence} {self.remedy}".strip()

    def document(self) -> dict[str, str]:
        """Return the entry of ``run.json``."""
        return asdict(self)


def announce(findings: Iterable[Finding], log: logging.Logger) -> None:
    """Write findings to a log as they are made, long before the result is written."""
    for finding in findings:
        log.log(_LEVELS[finding.severity], "%s", finding.text)

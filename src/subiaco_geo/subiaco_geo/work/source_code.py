"""Fingerprint of the source code that makes a cached result: changed code never reuses an old result."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import import_module
from pathlib import Path

#: Every package of the project may call this one.
_SHARED = "subiaco_geo"


@cache
def source_fingerprint(module: str) -> str:
    """Hash the source of a module's whole package, and of ``subiaco_geo`` on which every package rests.

    The whole package is hashed and not only the modules that one stage imports: reading all files takes
    milliseconds, and an import that is missed would reuse a wrong result without a word.

    Parameters
    ----------
    module : str
        Dotted name of an importable module, of which the first part is the package; or of a script.

    Returns
    -------
    str
        Hexadecimal digest, computed once in a process: a file that is edited later is not the code that runs.
    """
    digest = hashlib.sha256()
    for name in sorted({_SHARED, module.partition(".")[0]}):
        for label, path in _sources(name):
            digest.update(f"{name}/{label}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _sources(name: str) -> list[tuple[str, Path]]:
    """Return the source files of a package or of a single module, by their path in the package."""
    found = import_module(name)
    folders = [Path(folder) for folder in getattr(found, "__path__", ())]
    if folders:
        return sorted(
            (p.relative_to(folder).as_posix(), p) for folder in folders for p in folder.rglob("*.py")
        )
    file = getattr(found, "__file__", None)  # none in an interactive session
    return [("", Path(file))] if file else []

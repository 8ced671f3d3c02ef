"""Outputs appear whole or not at all: written beside, then renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from subiaco_geo.disk import ground_of, require_writable
from subiaco_geo.errors import InputError
from subiaco_geo.locks import held_directory, sweep


def refuse_existing(
    path: Path, overwrite: bool, remedy: str = "choose another place or pass --overwrite"
) -> None:
    """Raise where an output stands already and may not be replaced, or where none can be written."""
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already; {remedy}")
    ground = ground_of(path.absolute().parent)
    if not ground.is_dir():
        raise InputError(f"{ground}: is a file, so {path} cannot be written; choose another place")
    require_writable(ground)


def refuse_foreign(path: Path, marker: str | None) -> None:
    """Raise where the directory to be replaced does not look like an output of ours (no ``marker`` in it)."""
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path}: is a file, not a directory; choose another place")
    if marker is not None and any(path.iterdir()) and not (path / marker).exists():
        raise InputError(
            f"{path}: holds other things (no {marker}) and is not replaced; choose another place"
        )


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename on success, remove on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_directory(
    path: Path, *, overwrite: bool | None = None, marker: str | None = None
) -> Iterator[Path]:
    """Yield a temporary directory beside ``path``; rename on success, remove on failure.

    Parameters
    ----------
    path : Path
    overwrite : bool, optional
        Replace a directory that is there; it stays until the new one is whole. None where the user has no
        such choice.
    marker : str, optional
        A file that the old directory must hold to be replaced, so that a
        mistyped path costs nobody a folder of other things.
    """
    path = path.absolute()
    if overwrite is None:
        refuse_existing(path, overwrite=False, remedy="choose another place, or remove it first")
    else:
        refuse_existing(path, overwrite)
    refuse_foreign(path, marker)
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep(path.parent, f".{path.name}.partial-")
    with held_directory(path.with_name(f".{path.name}.partial-{os.getpid()}")) as temporary:
        yield temporary
        _swap_in(temporary, path)


def _swap_in(temporary: Path, path: Path) -> None:
    """Rename a directory into place; the one that stood there comes back if that fails."""
    if not path.exists():
        temporary.rename(path)
        return
    retired = path.with_name(f".{path.name}.{os.getpid()}.old")
    path.rename(retired)
    try:
        temporary.rename(path)
    except OSError:
        retired.rename(path)
        raise
    shutil.rmtree(retired)

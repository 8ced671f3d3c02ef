"""Hashes of inputs, so that a result names exactly what it was made from."""

from __future__ import annotations

import hashlib
from pathlib import Path

from subiaco_geo.errors import InputError


def hash_path(path: Path) -> str:
    """Return the SHA-256 of a file, or of every file of a directory in name order.

    Raises
    ------
    InputError
        Nothing is there.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or directory; check the name")
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        if file != path:
            digest.update(file.relative_to(path).as_posix().encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()

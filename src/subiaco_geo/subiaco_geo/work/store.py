"""Stores of finished tasks: named sets of arrays, on disk or in memory (object storage: ``object_store``)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import SEEK_CUR
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Protocol
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.array_files import read_array
from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError

Array = NDArray[Any]
Arrays = Mapping[str, Array]
_NAME_AT = 26  # in the local header of a member of a zip: lengths of its name and of what follows that


class Store(Protocol):
    """Keeps named sets of arrays under keys ``stage/name-hash``."""

    @property
    def shared(self) -> bool:
        """Whether other processes see the pieces."""
        ...

    def has(self, key: str) -> bool:
        """Tell whether a piece is finished."""
        ...

    def size(self, key: str) -> int:
        """Return the bytes of a finished piece; 0 where they are not known at once."""
        ...

    def load(self, key: str) -> Arrays:
        """Return the arrays of a finished piece; each is read when it is asked for."""
        ...

    def save(self, key: str, arrays: Arrays) -> None:
        """Keep the arrays of a piece: wholly or not at all."""
        ...

    def note(self, name: str, words: Mapping[str, Any]) -> None:
        """Leave a note on the pieces, as JSON."""
        ...


class Piece(Mapping[str, Array]):
    """Arrays of an ``.npz``, each read when it is asked for; between, the file is closed: there are many.

    Arrays are read where they lie: numpy's own reader opens the archive again and sums every byte.

    Parameters
    ----------
    name : str
        Of the file, for messages.
    open_file : callable
        Opens it for reading.
    """

    def __init__(self, name: str, open_file: Callable[[], BinaryIO]) -> None:
        self._name, self._open_file = name, open_file
        with self._opened() as stream, ZipFile(stream) as archive:
            self._members = {
                member.filename.removesuffix(".npy"): (member.header_offset, member.file_size)
                for member in archive.infolist()
            }

    @contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        try:
            with self._open_file() as stream:
                yield stream
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise InputError(
                f"{self._name}: a kept stage cannot be read ({error}); remove it, run again"
            ) from error

    def __getitem__(self, name: str) -> Array:
        header, size = self._members[name]
        with self._opened() as stream:
            stream.seek(header + _NAME_AT)
            name_length, extra_length = (int.from_bytes(stream.read(2), "little") for _ in range(2))
            stream.seek(name_length + extra_length, SEEK_CUR)
            return read_array(stream, size)

    def __contains__(self, name: object) -> bool:
        return name in self._members  # without reading the array

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)


@dataclass(frozen=True)
class DiskStore:
    """One uncompressed ``.npz`` a piece below a folder; no pickles.

    Parameters
    ----------
    root : Path
        Made when the first piece is saved.
    """

    root: Path
    shared: ClassVar[bool] = True

    def _path(self, key: str) -> Path:
        return self.root / f"{key}.npz"

    def has(self, key: str) -> bool:
        """Tell whether a piece is finished: files take their name when they are whole."""
        return self._path(key).is_file()

    def size(self, key: str) -> int:
        """Return the bytes of a finished piece."""
        return self._path(key).stat().st_size

    def load(self, key: str) -> Arrays:
        """Open a piece.

        Raises
        ------
        InputError
            Its file is missing or damaged.
        """
        path = self._path(key)
        return Piece(str(path), lambda: path.open("rb"))

    def save(self, key: str, arrays: Arrays) -> None:
        """Write a piece; its file appears whole."""
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        plain: dict[str, Any] = {name: np.asarray(values) for name, values in arrays.items()}
        with whole_file(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **plain)

    def note(self, name: str, words: Mapping[str, Any]) -> None:
        """Write a note beside the pieces."""
        self.root.mkdir(parents=True, exist_ok=True)
        with whole_file(self.root / name) as temporary:
            temporary.write_text(json.dumps(words, indent=1), encoding="utf-8")


@dataclass(frozen=True)
class MemoryStore:
    """Pieces in this process, for small work."""

    pieces: dict[str, Arrays] = field(default_factory=dict)
    shared: ClassVar[bool] = False

    def size(self, key: str) -> int:
        """Return the bytes of the arrays of a piece."""
        return sum(array.nbytes for array in self.pieces[key].values())

    def has(self, key: str) -> bool:
        """Tell whether a piece is finished."""
        return key in self.pieces

    def load(self, key: str) -> Arrays:
        """Return a piece."""
        return self.pieces[key]

    def save(self, key: str, arrays: Arrays) -> None:
        """Keep a piece."""
        self.pieces[key] = dict(arrays)

    def note(self, name: str, words: Mapping[str, Any]) -> None:
        """Do nothing: nobody could read it."""

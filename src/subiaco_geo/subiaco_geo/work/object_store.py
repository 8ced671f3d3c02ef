"""Finished tasks in object storage: ``http://``, and ``s3://``, ``gs://`` and whatever else fsspec reaches.

A piece is one object, written whole by one request, read whole, and never changed: a process holds what it
read last. A web server must answer GET, HEAD and PUT.
"""

from __future__ import annotations

import io
import json
import posixpath
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from http import HTTPStatus
from typing import Any, Protocol
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import Request, urlopen

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_geo.work.store import Arrays, Piece

_HELD_BYTES = 256 * 2**20  # of the pieces read last, in each process
_ANSWER = 60.0  # a web server may take so long to answer [s]


class _Files(Protocol):
    """What a store asks of its storage; the file systems of fsspec have it."""

    def exists(self, path: str) -> bool: ...

    def cat_file(self, path: str) -> bytes: ...

    def pipe_file(self, path: str, value: bytes) -> object: ...


def is_url(place: object) -> bool:
    """Tell whether a place is a URL and not a folder."""
    return isinstance(place, str) and "://" in place


@dataclass(frozen=True)
class ObjectStore:
    """Pieces below a URL, as ``.npz`` objects; rights come from the environment, as fsspec reads them.

    Parameters
    ----------
    url : str
        Such as ``s3://bucket/folder``.
    """

    url: str

    @property
    def shared(self) -> bool:
        """Whether other processes see the pieces."""
        return not self.url.startswith("memory:")

    def has(self, key: str) -> bool:
        """Tell whether a piece is finished."""
        path = self._path(key)
        if path in _HELD.pieces:
            return True
        try:
            return bool(_opened(self.url)[0].exists(path))
        except Exception as error:
            raise self._unreachable(error) from error

    def size(self, key: str) -> int:
        """Return 0: to ask the storage for every size would take longer than an order of tasks saves."""
        del key
        return 0

    def load(self, key: str) -> Arrays:
        """Open a piece.

        Raises
        ------
        InputError
            It is missing or damaged, or the storage does not answer.
        """
        path = self._path(key)
        held = _HELD.get(path)
        if held is None:
            try:
                held = bytes(_opened(self.url)[0].cat_file(path))
            except Exception as error:
                raise self._unreachable(error, key) from error
            _HELD.add(path, held)
        return Piece(f"{self.url}/{key}.npz", lambda: io.BytesIO(held))

    def save(self, key: str, arrays: Arrays) -> None:
        """Write a piece by one request."""
        plain: dict[str, Any] = {name: np.asarray(values) for name, values in arrays.items()}
        stream = io.BytesIO()
        np.savez(stream, **plain)
        self._put(self._path(key), stream.getvalue())

    def note(self, name: str, words: Mapping[str, Any]) -> None:
        """Write a note beside the pieces."""
        self._put(posixpath.join(_opened(self.url)[1], name), json.dumps(words, indent=1).encode())

    def _path(self, key: str) -> str:
        return posixpath.join(_opened(self.url)[1], f"{key}.npz")

    def _put(self, path: str, content: bytes) -> None:
        try:
            _opened(self.url)[0].pipe_file(path, content)
        except Exception as error:
            raise self._unreachable(error) from error

    def _unreachable(self, error: Exception, key: str = "") -> InputError:
        where = f"{self.url}/{key}" if key else self.url
        told = str(error) or type(error).__name__
        return InputError(
            f"{where}: the storage does not answer as expected ({told}); check address and rights"
        )


class _Held:
    """Contents of the pieces read last in this process, up to a number of bytes."""

    def __init__(self, limit: int) -> None:
        self.pieces: OrderedDict[str, bytes] = OrderedDict()
        self._limit, self._bytes = limit, 0

    def get(self, path: str) -> bytes | None:
        """Return a piece that is held, and hold it longest."""
        if path in self.pieces:
            self.pieces.move_to_end(path)
        return self.pieces.get(path)

    def add(self, path: str, content: bytes) -> None:
        """Hold a piece in place of those not asked for longest."""
        if path in self.pieces or len(content) > self._limit:
            return
        self.pieces[path] = content
        self._bytes += len(content)
        while self._bytes > self._limit:
            self._bytes -= len(self.pieces.popitem(last=False)[1])


_HELD = _Held(_HELD_BYTES)


class _WebServer:
    """Files of a web server, whose paths are URLs: read by GET, written by PUT."""

    def exists(self, path: str) -> bool:
        """Tell whether the server knows a file."""
        try:
            self._ask("HEAD", path)
        except HTTPError as error:
            if error.code in (HTTPStatus.NOT_FOUND, HTTPStatus.GONE):
                return False
            raise
        return True

    def cat_file(self, path: str) -> bytes:
        """Return the content of a file."""
        return self._ask("GET", path)

    def pipe_file(self, path: str, value: bytes) -> None:
        """Write a file."""
        self._ask("PUT", path, value)

    @staticmethod
    def _ask(method: str, path: str, content: bytes | None = None) -> bytes:
        request = Request(quote(path, safe=":/?&=%@[]"), content, method=method)  # noqa: S310 - http or https alone
        with urlopen(request, timeout=_ANSWER) as answer:  # noqa: S310
            return bytes(answer.read())


@cache
def _opened(url: str) -> tuple[_Files, str]:
    """Return the file system and the root path of a URL, once in a process.

    Raises
    ------
    InputError
        fsspec, or the package of this kind of storage, is not installed.
    """
    if url.startswith(("http://", "https://")):
        return _WebServer(), url.rstrip("/")
    if url.startswith(("file:", "local:")):
        raise InputError(f"{url}: names a folder; give its path")
    try:
        from fsspec.core import url_to_fs

        files, root = url_to_fs(url, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{url}: this kind of storage cannot be reached ({error}); install its package"
        ) from error
    return files, str(root).rstrip("/")

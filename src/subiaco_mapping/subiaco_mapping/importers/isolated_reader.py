"""Readers of native libraries in a child process, which a damaged file may end."""

from __future__ import annotations

import multiprocessing as mp
import signal
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from subiaco_geo.errors import InputError

_Item = TypeVar("_Item")
_BATCH = 64  # items sent at once


def read_isolated(recording: Path, reader: Callable[..., Iterator[_Item]], *args: object) -> Iterator[_Item]:
    """Yield what a reader yields, run in a child process.

    Parameters
    ----------
    recording : Path
        The file that is read, for the message.
    reader : callable
        A function of a module; it and its arguments are pickled, and so is every item.
    args
        Arguments of the reader.

    Raises
    ------
    InputError
        The reader raised it, or its process ended before the reader did.
    """
    context = mp.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(theirs, reader, args), daemon=True)
    process.start()
    theirs.close()
    try:
        while True:
            try:
                kind, content = ours.recv()
            except EOFError:
                process.join()
                raise InputError(_death(recording, process.exitcode)) from None
            if kind == "items":
                yield from content
            elif kind == "error":
                raise content
            else:
                return
    finally:
        ours.close()
        process.terminate()
        process.join()


def _death(recording: Path, code: int | None) -> str:
    ended = f"exit code {code}"
    if code is not None and code < 0:
        ended = signal.Signals(-code).name
    return (
        f"{recording}: damaged: the library that reads it ended its process ({ended});"
        " copy the file again from the logger, or cut it before the damage"
    )


def _serve(out: Connection, reader: Callable[..., Iterator[Any]], args: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    batch: list[Any] = []
    try:
        for item in reader(*args):
            batch.append(item)
            if len(batch) == _BATCH:
                out.send(("items", batch))
                batch = []
        out.send(("items", batch))
        out.send(("end", None))
    except InputError as error:
        out.send(("items", batch))
        out.send(("error", error))
    except BrokenPipeError:  # the parent has had enough
        pass

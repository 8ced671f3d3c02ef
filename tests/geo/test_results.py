"""Results of stages: whatever dataclass a stage returns comes back from the store, field by field."""

import json
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from subiaco_geo.work.results import pack, register_codec, unpack
from subiaco_geo.work.store import DiskStore


class Kind(IntEnum):
    """An enumeration among the plain values."""

    ROAD = 3


class Shape:
    """A foreign type, which JSON does not know."""

    def __init__(self, name):
        self.name = name


register_codec(Shape, lambda shape: shape.name, Shape)


@dataclass(frozen=True)
class Row:
    """A row without arrays."""

    kind: Kind
    ids: tuple[int, ...]
    height: float
    shape: Shape
    note: str = ""


@dataclass(frozen=True)
class Grid:
    """An array beside plain values, with a default."""

    corner: NDArray[np.float64]
    shape: tuple[int, int]
    details: Mapping[str, float]
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Tile:
    """A result of a stage."""

    xyz: NDArray[np.float64]
    intensity: NDArray[np.float32] | None
    grid: Grid
    other: Grid | None
    rows: tuple[Row, ...]
    failed: str | None


def tile(xyz=None, **more):
    grid = Grid(np.array([1.0, 2.0]), (3, 4), {"rmse": 0.1}, ("north",))
    rows = (Row(Kind.ROAD, (1, -2), float("nan"), Shape("box"), "first"),)
    return replace(Tile(np.zeros((2, 3)) if xyz is None else xyz, None, grid, None, rows, None), **more)


def test_a_result_comes_back_with_its_types(tmp_path):
    store = DiskStore(tmp_path)
    store.save("stage/0_0-x", pack(tile(failed="why")))
    found = unpack(Tile, store.load("stage/0_0-x"))
    assert isinstance(found, Tile)
    assert (found.intensity, found.other, found.failed) == (None, None, "why")
    assert (found.grid.shape, found.grid.words, found.grid.details) == ((3, 4), ("north",), {"rmse": 0.1})
    (row,) = found.rows
    assert (row.kind, row.ids, row.shape.name, row.note) == (Kind.ROAD, (1, -2), "box", "first")
    assert np.isnan(row.height)


@given(
    hnp.arrays(st.sampled_from([np.float64, np.float32, np.int32, np.bool_]), hnp.array_shapes(max_dims=3))
)
def test_arrays_keep_their_values_types_and_shapes(values):
    found = unpack(Tile, pack(tile(values, intensity=values)))
    for read in (found.xyz, found.intensity):
        assert read.dtype == values.dtype
        np.testing.assert_array_equal(read, values)


@given(st.floats(allow_nan=False), st.text(max_size=9), st.lists(st.integers(), max_size=4))
def test_plain_values_are_exact(number, text, ids):
    row = Row(Kind.ROAD, tuple(ids), number, Shape(text), text)
    (found,) = unpack(Tile, pack(tile(rows=(row,)))).rows
    assert (found.height, found.note, found.ids, found.shape.name) == (number, text, tuple(ids), text)


def test_a_loaded_result_is_handed_to_another_process_whole(tmp_path):
    store = DiskStore(tmp_path)
    store.save("stage/0_0-x", pack(tile()))
    found = pickle.loads(pickle.dumps(unpack(Tile, store.load("stage/0_0-x"))))
    assert type(found) is Tile
    assert (found.xyz.shape, found.grid.corner.tolist(), found.failed) == ((2, 3), [1.0, 2.0], None)


def test_a_loaded_result_reads_what_is_asked_for_and_no_more():
    class Counting(dict):
        asked: ClassVar[list[str]] = []

        def __getitem__(self, name):
            self.asked.append(name)
            return super().__getitem__(name)

    arrays = Counting(pack(tile()))
    found = unpack(Tile, arrays)
    assert Counting.asked == []
    assert found.grid.corner.tolist() == [1.0, 2.0]
    assert "xyz" not in Counting.asked
    asked = len(Counting.asked)
    assert found.grid.corner is found.grid.corner
    assert len(Counting.asked) == asked


def test_a_loaded_result_is_stored_again_the_same():
    first = pack(tile())
    second = pack(unpack(Tile, first))
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert {f.name for f in fields(unpack(Tile, first))} == {f.name for f in fields(Tile)}


def test_what_is_no_dataclass_is_refused():
    with pytest.raises(TypeError, match="dict: the result of a stage is a dataclass"):
        pack({"xyz": np.zeros(3)})
    with pytest.raises(AttributeError, match="no field heigth"):
        _ = unpack(Tile, pack(tile())).heigth


def test_the_plain_values_are_readable_json():
    assert json.loads(str(pack(tile())["grid.plain"]))["shape"] == [3, 4]

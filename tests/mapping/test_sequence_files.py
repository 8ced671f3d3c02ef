"""A finished sequence comes back from its file as it was, and nothing else does."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.errors import InputError
from subiaco_mapping.checkpoint.sequence_files import TABLES, pack, unpack
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.loop_closure.submaps import Submap
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.sequences import SequenceRecord, begin_sequence

CONFIG = MappingConfig()
WHOLE = st.integers(-(2**63), 2**63 - 1)
NUMBER = st.floats(width=64)


def arrays(*shape: int) -> st.SearchStrategy[np.ndarray]:
    size = int(np.prod(shape))
    return st.lists(NUMBER, min_size=size, max_size=size).map(lambda v: np.array(v).reshape(shape))


POSE = st.builds(
    OdometryPose, WHOLE, arrays(4, 4), arrays(6, 6), WHOLE, NUMBER, st.booleans(), WHOLE, st.booleans()
)
FIX = st.builds(GnssFix, WHOLE, NUMBER, NUMBER, NUMBER, arrays(3, 3), WHOLE)
PLACES = st.builds(Extrinsics, arrays(4, 4), st.none() | arrays(4, 4), st.none() | arrays(3))
FACT = st.recursive(
    st.none() | st.booleans() | st.integers() | NUMBER | st.text(),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(), inner, max_size=2),
    max_leaves=4,
)


def few(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(strategy, max_size=2)


LISTS = st.fixed_dictionaries(
    {
        "poses": few(POSE),
        "accel": few(arrays(3)),
        "modes": few(st.text()),
        "columns": few(st.tuples(WHOLE, WHOLE)),
        "dropped_points": WHOLE,
        "fixes": few(FIX),
        "refused_fixes": WHOLE,
        "headings": few(st.builds(HeadingSample, WHOLE, NUMBER, NUMBER)),
        "refused_headings": WHOLE,
        "facts": st.dictionaries(st.text(), FACT, max_size=2),
    }
)


def plain(value: object) -> object:
    """Everything a value holds, types and bits included, comparable with ``==``."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, float):
        return "nan" if np.isnan(value) else value.hex()
    if isinstance(value, list | tuple):
        return type(value).__name__, [plain(one) for one in value]
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if hasattr(value, "__dict__"):
        return type(value).__name__, {key: plain(one) for key, one in vars(value).items()}
    return type(value).__name__, value


def survivors(record: SequenceRecord) -> dict[str, object]:
    """All of a record but what only an unfinished one needs."""
    found = {field.name: plain(getattr(record, field.name)) for field in fields(record)}
    found["submaps"] = None if record.submaps is None else plain(record.submaps.done)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("work") / "000"


@given(name=st.text(), places=PLACES, lists=LISTS, ways=few(st.tuples(WHOLE, NUMBER)))
def test_every_field_comes_back_to_the_bit(
    folder: Path, name: str, places: Extrinsics, lists: dict[str, Any], ways: list[tuple[int, float]]
) -> None:
    record = begin_sequence(name, places, folder, CONFIG)
    for field, value in lists.items():
        setattr(record, field, value)
    record.spool.restore(len(record.poses))
    assert record.submaps is not None
    submaps = folder / "submaps"
    record.submaps.done = [Submap(*pair, submaps / f"{k:05d}.npy") for k, pair in enumerate(ways)]
    assert survivors(unpack(pack(record), folder, CONFIG)) == survivors(record)


@pytest.mark.parametrize("table", sorted(TABLES))
def test_every_field_of_a_measurement_is_in_its_table(table: str) -> None:
    row, columns = TABLES[table]
    assert list(columns) == [field.name for field in fields(row)]


def short_drive(folder: Path, config: MappingConfig) -> SequenceRecord:
    """Two scans of a wall, 12 m apart."""
    record = begin_sequence("drive", Extrinsics(), folder, config)
    wall = np.stack([np.full(50, 5.0), np.linspace(-5, 5, 50), np.zeros(50)], axis=1)
    for k in range(2):
        T = np.eye(4)
        T[0, 3] = 12.0 * k
        scan = DeskewedScan(k, wall + k, np.arange(50, dtype=np.float32), "gyro")
        record.add(OdometryPose(k, T, np.eye(6), 50, 0.01, False, 0), scan)
    return record


@pytest.mark.parametrize("loops", [True, False])
def test_scans_and_submaps_are_found_where_the_folder_was_moved_to(tmp_path: Path, loops: bool) -> None:
    config = CONFIG.model_copy(update={"loops": LoopConfig(enabled=loops)})
    record = short_drive(tmp_path / "there", config)
    scans = [record.spool.read(k).xyz for k in range(2)]
    clouds = [submap.points() for submap in record.submaps.done] if record.submaps else []
    packed = pack(record)
    (tmp_path / "there").rename(tmp_path / "here")
    found = unpack(packed, tmp_path / "here", config)
    assert len(found.spool) == 2
    for k, scan in enumerate(scans):
        np.testing.assert_array_equal(found.spool.read(k).xyz, scan)
    assert (found.submaps is not None) == loops
    again = [submap.points() for submap in found.submaps.done] if found.submaps else []
    assert len(again) == len(clouds) == int(loops)
    for one, other in zip(again, clouds, strict=True):
        np.testing.assert_array_equal(one, other)


def changed(packed: bytes, **arrays: np.ndarray) -> bytes:
    with np.load(io.BytesIO(packed)) as file:
        stream = io.BytesIO()
        np.savez(stream, **{**file, **arrays})
    return stream.getvalue()


def test_another_file_is_refused(tmp_path: Path) -> None:
    packed = pack(short_drive(tmp_path, CONFIG))
    objects = np.array([{"an": "object"}, None], dtype=object)
    wrong = [
        b"",
        b"garbage",
        packed[:-30],
        changed(packed, accel=objects),
        changed(packed, **{"poses.stamp_ns": np.array([0.0, 1.0])}),
        changed(packed, **{"poses.stamp_ns": np.array([0])}),
        changed(packed, **{"poses.covariance": np.zeros((2, 36))}),
        changed(packed, rest=np.frombuffer(b"{}", dtype=np.uint8)),
        changed(packed, rest=np.frombuffer(b"[1", dtype=np.uint8)),
    ]
    for file in wrong:
        with pytest.raises(InputError, match="cannot be read"):
            unpack(file, tmp_path, CONFIG)

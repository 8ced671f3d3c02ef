"""Damaged inputs may be refused, and nothing else: no crash, no hang, no memory for what is not there."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz_cases import KINDS, MEMORY, Fault, Target, bounds, run
from fuzz_targets import TARGETS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from subiaco_geo.errors import InputError

NAMED = {target.name: target for target in TARGETS}
EDITS = st.lists(
    st.tuples(st.integers(0, KINDS - 1), st.integers(0, 2**31), st.integers(0, 2**31)), min_size=1, max_size=5
)
MANY = 10**12


@pytest.fixture(scope="module")
def seeds(tmp_path_factory) -> Callable[[Target], tuple[list[bytes], Path]]:
    """Whole inputs by target, read once before anything is bounded: that loads the libraries."""
    made: dict[str, tuple[list[bytes], Path]] = {}

    def of(target: Target) -> tuple[list[bytes], Path]:
        if target.name not in made:
            folder = tmp_path_factory.mktemp("fuzz")
            made[target.name] = (target.seeds(folder), folder)
            for data in made[target.name][0]:
                (folder / f"case{target.suffix}").write_bytes(data)
                target.read(folder / f"case{target.suffix}")
        return made[target.name]

    return of


@pytest.mark.parametrize("name", NAMED)
def test_a_damaged_input_is_read_or_refused_in_one_line(name: str, seeds) -> None:
    target = NAMED[name]
    whole, folder = seeds(target)
    assert all(run(target, data, folder) for data in whole)

    @settings(max_examples=12, suppress_health_check=list(HealthCheck))
    @given(which=st.integers(0, len(whole) - 1), edits=EDITS)
    def trial(which: int, edits: list[tuple[int, int, int]]) -> None:
        run(target, target.damage(whole[which], edits), folder)

    trial()


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_a_ply_that_claims_ten_to_the_twelve_is_refused(
    form: str, element: str, seeds, tmp_path: Path
) -> None:
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat {form} 1.0\nelement {element} {MANY}\n{axes}"
    seeds(NAMED["ply"])
    assert run(NAMED["ply"], f"{head}end_header\n1 2 3\n".encode(), tmp_path) is False


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_that_claims_ten_to_the_twelve_is_refused(form: str, seeds, tmp_path: Path) -> None:
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {MANY}\nDATA {form}\n"
    seeds(NAMED["pcd"])
    for packed in (8, 2**32 - 1):
        body = struct.pack("<II", packed, MANY * 12 % 2**32) + b"1 2 3\n"
        assert run(NAMED["pcd"], head.encode() + body, tmp_path) is False


@pytest.mark.parametrize("name", ["las", "laz"])
@pytest.mark.parametrize(
    ("at", "form", "what"),
    [
        (247, "<Q", MANY),
        (247, "<Q", 10**8),
        (100, "<I", 2**32 - 1),
        (96, "<I", 2**32 - 1),
        (243, "<I", 2**32 - 1),
    ],
    ids=["points", "fewer points", "records", "offset", "extended records"],
)
def test_a_las_header_that_claims_what_the_file_cannot_hold_is_refused(
    name: str, at: int, form: str, what: int, seeds, tmp_path: Path
) -> None:
    data = bytearray(seeds(NAMED[name])[0][0])
    struct.pack_into(form, data, at, what)
    assert run(NAMED[name], bytes(data), tmp_path) is False


def test_a_laz_whose_table_claims_four_thousand_million_chunks_does_not_end_the_process(
    seeds, tmp_path: Path
) -> None:
    data = bytearray(seeds(NAMED["laz"])[0][0])
    (offset,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, offset)
    struct.pack_into("<I", data, table + 4, 2**32 - 1)
    assert run(NAMED["laz"], bytes(data), tmp_path) is False


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
            f"{c}: &{c} [{','.join([f'*{b}'] * 10)}]\n" for b, c in zip("abcdefghi", "bcdefghij", strict=True)
        ),
        "a: &a [*a, *a]",
        "[" * 5000,
        "when: 2025-13-45",
        "!!python/object/apply:os.getcwd []",
    ],
    ids=["ten thousand million laughs", "inside itself", "deep", "thirteenth month", "a call"],
)  # fmt: skip
def test_yaml_that_unfolds_calls_or_is_no_value_is_refused(text: str, seeds, tmp_path: Path) -> None:
    seeds(NAMED["configuration"])
    inside = "\n".join("    " + line for line in text.splitlines())
    assert run(NAMED["configuration"], f"/**:\n  ros__parameters:\n{inside}\n".encode(), tmp_path) is False


@pytest.mark.parametrize(("old", "new"), [("512", "1000000000000"), ("512", "2147483647"), ("16", "0")])
def test_sensor_metadata_of_a_size_that_no_sensor_has_is_refused(
    old: str, new: str, seeds, tmp_path: Path
) -> None:
    text = seeds(NAMED["sensor metadata"])[0][0].decode()
    key = "columns_per_frame" if old == "512" else "pixels_per_column"
    damaged_text = text.replace(f'"{key}": {old}', f'"{key}": {new}').replace(
        f'"{key}":{old}', f'"{key}":{new}'
    )
    assert damaged_text != text
    assert run(NAMED["sensor metadata"], damaged_text.encode(), tmp_path) is False


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("fault_107.mcap", "drive bag"),
        ("fault_10784.mcap", "bag"),
        ("fault_2084.bin", "packets"),
        ("fault_6012.tum", "tum"),
        ("crash_import.pcap", "pcap"),
        ("crash_import.osf", "osf"),
        ("crc_test.pcap", "pcap"),
        ("empty_pcap.pcap", "pcap"),
    ],
)
def test_recordings_that_raised_before_are_read_or_refused(
    shared_data: Path, name: str, target: str, seeds, tmp_path: Path
) -> None:
    path = shared_data / "ouster" / "negative" / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    seeds(NAMED[target])
    run(NAMED[target], path.read_bytes(), tmp_path)


def test_the_bounds_catch_a_reader_that_takes_memory_hangs_or_raises(tmp_path: Path) -> None:
    def refuse(_path: Path) -> None:
        raise InputError("one\ntwo")

    for read, said in (
        (lambda _path: bytearray(2 * MEMORY), "MemoryError"),
        (lambda _path: {}["key"], "KeyError"),
        (refuse, "no single line"),
    ):
        with pytest.raises(Fault, match=said):
            run(Target("bad", ".bin", read, lambda _folder: []), b"", tmp_path)
    with bounds():
        pass

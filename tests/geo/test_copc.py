"""COPC files are read back whole, and by level, with the library that others use."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from subiaco_geo import copc_io
from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.copc_io import octree, write_copc_parts

ORIGIN = np.array([391_000.0, 6_464_000.0, 20.0])


def street(count: int = 60_000, seed: int = 5) -> PointCloud:
    rng = np.random.default_rng(seed)
    xyz = np.round(rng.uniform(0, [400.0, 150.0, 12.0], (count, 3)), 3)
    fields: dict[str, NDArray[np.generic]] = {
        "intensity": rng.integers(0, 60_000, count).astype(np.uint16),
        "instance": np.arange(count, dtype=np.int32),
        "lod95": rng.uniform(0, 1, count).astype(np.float32),
        **{name: rng.integers(0, 255, count).astype(np.uint8) for name in ("red", "green", "blue")},
    }
    return PointCloud(xyz, ORIGIN, "EPSG:7850", fields)


def test_every_point_comes_back_once_with_its_fields_and_the_crs(tmp_path: Path) -> None:
    cloud = street()
    write_cloud(tmp_path / "city.copc.laz", cloud)
    back = read_cloud(tmp_path / "city.copc.laz")
    order = np.argsort(back.fields["instance"])
    np.testing.assert_array_equal(back.fields["instance"][order], cloud.fields["instance"])
    np.testing.assert_allclose(back.world()[order], cloud.world(), atol=1e-6)
    for name in ("intensity", "lod95", "red"):
        np.testing.assert_array_equal(back.fields[name][order], cloud.fields[name])
    assert back.crs is not None
    assert "7850" in back.crs


def test_a_viewer_gets_a_thin_cloud_of_the_whole_and_all_points_of_a_corner(tmp_path: Path) -> None:
    cloud = street()
    write_cloud(tmp_path / "city.copc.laz", cloud)
    with laspy.CopcReader.open(tmp_path / "city.copc.laz") as reader:
        thin = reader.query(level=0)
        low, high = ORIGIN, ORIGIN + np.array([40.0, 40.0, 12.0])
        corner = reader.query(bounds=laspy.copc.Bounds(low, high))
    assert 0 < len(thin) < len(cloud)
    extent = [np.ptp(np.asarray(getattr(thin, axis))) for axis in "xyz"]
    assert extent == pytest.approx([400, 150, 12], abs=8.0)
    inside = np.all((cloud.xyz <= [40.0, 40.0, 12.0]), axis=1)
    assert len(corner) == np.count_nonzero(inside)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 30_000), st.integers(0, 2**31))
def test_the_octree_holds_every_point_once_in_the_node_where_it_lies(count: int, seed: int) -> None:
    local = np.random.default_rng(seed).uniform(0, 50, (count, 3))
    local[: count // 2] = local[0]  # doubles too
    seen = []
    for (level, *node), members in octree(local, 50.0 + 1e-6):
        assert (np.floor(local[members] * (2**level / (50.0 + 1e-6))) == node).all()
        seen.append(members)
    assert (np.sort(np.concatenate(seen)) == np.arange(count)).all()


def test_a_cloud_in_parts_and_pieces_holds_the_same_points_as_a_whole_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = street()
    parts = [cloud.select(members).rebased(ORIGIN + k) for k, members in enumerate(np.array_split(
        np.arange(len(cloud)), 7))]  # fmt: skip
    monkeypatch.setattr(copc_io, "_HELD", 3000)
    monkeypatch.setattr(copc_io, "_SMALL", 500)
    write_copc_parts(tmp_path / "parts.copc.laz", lambda: iter(parts))
    with laspy.CopcReader.open(tmp_path / "parts.copc.laz") as reader:
        header, whole, thin = reader.header, reader.query(), reader.query(level=0)
        fine = [len(reader.query(level=level)) for level in range(4)]
    assert header.point_count == len(whole) == len(cloud) == sum(header.number_of_points_by_return)
    order = np.argsort(whole["instance"])
    np.testing.assert_array_equal(whole["instance"][order], cloud.fields["instance"])
    np.testing.assert_array_equal(whole["lod95"][order], cloud.fields["lod95"])
    xyz = np.stack([np.asarray(whole[axis]) for axis in "xyz"], axis=1)
    np.testing.assert_allclose(xyz[order], cloud.world(), atol=1e-6)
    np.testing.assert_allclose(header.mins, cloud.world().min(axis=0), atol=1e-6)
    np.testing.assert_allclose([np.ptp(np.asarray(thin[axis])) for axis in "xyz"], [400, 150, 12], atol=8)
    assert 500 < fine[0] < fine[1]
    assert fine[2] > 0


def test_a_viewer_finds_all_points_of_a_corner_whichever_piece_holds_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = street(30_000)
    monkeypatch.setattr(copc_io, "_HELD", 1000)
    monkeypatch.setattr(copc_io, "_SMALL", 200)
    write_cloud(tmp_path / "city.copc.laz", cloud)
    corner = laspy.copc.Bounds(ORIGIN + 40.0, ORIGIN + np.array([260.0, 90.0, 200.0]))
    corner.mins[2] = 0.0
    with laspy.CopcReader.open(tmp_path / "city.copc.laz") as reader:
        found = reader.query(bounds=corner)
    inside = ((cloud.xyz[:, :2] >= 40.0 - 1e-9) & (cloud.xyz[:, :2] <= [260.0, 90.0])).all(axis=1)
    assert sorted(found["instance"]) == sorted(cloud.fields["instance"][inside])


@pytest.mark.parametrize("count", [1, 10, 1000, 30_000])
def test_a_small_cloud_comes_back_whole(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(3)
    fields = {
        "n": rng.integers(1, 9, count).astype(np.uint32),
        "spread": rng.random(count).astype(np.float32),
    }
    cloud = PointCloud(rng.random((count, 3)) * 50.0, np.array([391_000.0, 6_460_000.0, 10.0]), fields=fields)
    write_cloud(tmp_path / "small.copc.laz", cloud)
    back = read_cloud(tmp_path / "small.copc.laz")
    assert len(back) == count
    assert sorted(back.fields["n"]) == sorted(fields["n"])

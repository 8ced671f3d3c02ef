"""COPC files are read back whole, and by level, with the library that others use."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.copc_io import octree

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

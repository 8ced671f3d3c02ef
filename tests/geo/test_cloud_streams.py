"""Clouds written part by part: the file is the same, and appears whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from subiaco_geo import las_writing, ply_io
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud, from_world
from subiaco_geo.errors import InputError
from subiaco_geo.las_writing import las_stream

MGA = "EPSG:7850"


def street(n: int = 40) -> PointCloud:
    """A cloud with the fields of a map, seed 7."""
    rng = np.random.default_rng(7)
    return from_world(
        np.array([389_000.0, 6_463_000.0, 10.0]) + rng.uniform(0, 300, (n, 3)),
        MGA,
        intensity=rng.integers(0, 3000, n).astype(np.float32),
        normals=rng.normal(size=(n, 3)),
        n=rng.integers(1, 90, n).astype(np.uint32),
        number=rng.integers(0, 2**40, n),
        seen=rng.uniform(size=n) > 0.5,
    )


@pytest.mark.parametrize("suffix", [".laz", ".las"])
def test_clouds_appended_one_after_another_read_back_as_one(tmp_path: Path, suffix: str) -> None:
    cloud = street()
    cut = len(cloud) // 3
    near, far = cloud.select(np.arange(cut)), cloud.select(np.arange(cut, len(cloud)))
    write_cloud(tmp_path / f"whole{suffix}", cloud)
    with las_stream(tmp_path / f"parts{suffix}") as stream:
        stream.append(near)
        stream.append(far.rebased(far.origin + np.array([300.0, -200.0, 10.0])))
        assert not (tmp_path / f"parts{suffix}").exists()
    assert (tmp_path / f"parts{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", [".ply", ".laz", ".las"])
def test_a_file_does_not_depend_on_the_parts_it_is_written_in(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_cloud(tmp_path / f"whole{suffix}", street())
    for module in (las_writing, ply_io):
        monkeypatch.setattr(module, "_PART", 7)
    write_cloud(tmp_path / f"parts{suffix}", street())
    assert (tmp_path / f"parts{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()


@pytest.mark.parametrize(
    ("first", "second", "match"),
    [
        (PointCloud(np.eye(3)), PointCloud(np.eye(3), fields={"n": np.ones(3)}), "differ in CRS or fields"),
        (PointCloud(np.eye(3), crs=MGA), PointCloud(np.eye(3)), "differ in CRS or fields"),
        (PointCloud(np.eye(3)), PointCloud(np.zeros((0, 3))), "empty"),
        (PointCloud(np.eye(3)), PointCloud(np.full((1, 3), np.nan)), "NaN"),
    ],
)
def test_parts_that_do_not_fit_leave_no_file(
    tmp_path: Path, first: PointCloud, second: PointCloud, match: str
) -> None:
    def write() -> None:
        with las_stream(tmp_path / "a.laz") as stream:
            stream.append(first)
            stream.append(second)

    with pytest.raises(InputError, match=match):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_stream_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.laz: the cloud is empty"), las_stream(tmp_path / "a.laz"):
        pass
    assert list(tmp_path.iterdir()) == []

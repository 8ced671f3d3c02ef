"""A window of a cloud in its file holds what a look at all of its points finds."""

import pickle

import numpy as np
import pytest

from subiaco_geo import cloud_windows
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.clouds import PointCloud

ORIGIN = np.array([391_200.0, 6_464_500.0, 30.0])


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(3)
    xyz = rng.uniform([0, 0, 0], [100, 60, 8], (5000, 3))
    ids = rng.permutation(5000).astype(np.int32)
    return PointCloud(xyz[np.argsort(xyz[:, 0] // 20)], ORIGIN, "EPSG:7850", {"instance": ids, "n": ids})


@pytest.mark.parametrize("ending", [".ply", ".laz"])
def test_a_window_finds_what_a_plain_comparison_finds_and_reads_little(cloud, tmp_path, monkeypatch, ending):
    monkeypatch.setattr(cloud_windows, "RUN", 256)
    write_cloud(tmp_path / f"cloud{ending}", cloud)
    opened = CloudFile(tmp_path / f"cloud{ending}", ("instance",))
    np.testing.assert_allclose(opened.low, cloud.world().min(axis=0), atol=1e-3)
    np.testing.assert_allclose(opened.high, cloud.world().max(axis=0), atol=1e-3)
    xy, rng = cloud.world()[:, :2], np.random.default_rng(4)
    for _ in range(10):
        low = ORIGIN[:2] + rng.uniform(-30, 90, 2)
        high = low + rng.uniform(0.5, 60, 2)
        plain = ((xy >= low) & (xy < high)).all(axis=1)
        found = opened.inside(*low, *high)
        assert set(found.fields) == {"instance"}
        assert found.fields["instance"].tolist() == cloud.fields["instance"][plain].tolist()
        np.testing.assert_allclose(found.world(), cloud.world()[plain], atol=6e-4)
    reads = []
    read = opened._read
    opened._run = lambda run: reads.append(run) or read(run)
    opened.inside(*ORIGIN[:2], *(ORIGIN[:2] + 10.0))
    assert 0 < len(reads) <= 5


def test_a_window_far_from_all_points_is_empty_and_keeps_the_fields(cloud, tmp_path):
    write_cloud(tmp_path / "cloud.ply", cloud)
    found = CloudFile(tmp_path / "cloud.ply", ("instance", "missing")).inside(0.0, 0.0, 9.0, 9.0)
    assert len(found) == 0
    assert found.fields["instance"].dtype == np.int32


@pytest.mark.parametrize(("run", "kept"), [(256, True), (512, False)])
def test_a_file_that_can_only_be_read_whole_gives_every_point_once(cloud, tmp_path, monkeypatch, run, kept):
    monkeypatch.setattr(cloud_windows, "RUN", run)
    write_cloud(tmp_path / "cloud.laz", cloud)
    opened = CloudFile(tmp_path / "cloud.laz", None)
    if kept:  # not read again
        (tmp_path / "cloud.laz").unlink()
        assert sum(len(part) for part in opened.parts()) == len(cloud)
    found = opened.inside(*ORIGIN[:2], *(ORIGIN[:2] + 101.0))
    assert found.fields["instance"].tolist() == cloud.fields["instance"].tolist()


def test_another_process_gets_an_opened_file_without_what_was_read_of_it(cloud, tmp_path):
    write_cloud(tmp_path / "cloud.ply", cloud)
    opened = CloudFile(tmp_path / "cloud.ply", ("instance",))
    box = (*ORIGIN[:2], *(ORIGIN[:2] + 10.0))
    found = opened.inside(*box)
    handed = pickle.dumps(opened)
    assert len(handed) < 5_000  # the points stay in the file
    again = pickle.loads(handed).inside(*box)
    assert again.xyz.tolist() == found.xyz.tolist()

"""Clouds and beams read and written part by part are what they are as a whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.cloud_parts import cloud_parts
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.las_writing import las_stream
from subiaco_geo.maps import load_epoch, write_map
from subiaco_geo.ply_io import write_ply_parts
from subiaco_geo.sources import open_epoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.visibility import VisibilityGrid, load_visibility, save_visibility, visibility_parts

ORIGIN = np.array([391_000.0, 6_460_000.0, 0.0])
CRS = "EPSG:7850"


def cloud(count, seed=1):
    rng = np.random.default_rng(seed)
    fields = {
        "intensity": rng.uniform(0, 200, count).astype(np.float32),
        "instance": np.arange(count, dtype=np.int32),
    }
    return PointCloud(rng.uniform(-50, 50, (count, 3)), ORIGIN, CRS, fields)


@pytest.mark.parametrize("name", ["a.ply", "a.laz", "a.las"])
@settings(max_examples=8, deadline=None)
@given(count=st.integers(1, 60), size=st.integers(1, 70))
def test_parts_of_a_file_are_its_points_in_order(tmp_path_factory, name, count, size):
    path = tmp_path_factory.mktemp("parts") / name
    write_cloud(path, cloud(count))
    whole = read_cloud(path)
    parts = list(cloud_parts(path, ("instance", "absent"), size))
    assert max(map(len, parts)) <= size
    assert all(set(part.fields) == {"instance"} and part.crs == CRS for part in parts)
    assert np.concatenate([part.world() for part in parts]) == pytest.approx(whole.world(), abs=1e-9)
    assert np.concatenate([part.fields["instance"] for part in parts]).tolist() == list(range(count))


@pytest.mark.parametrize("name", ["a.ply", "a.laz"])
def test_a_cut_file_is_refused_when_its_end_is_reached(tmp_path, name):
    path = tmp_path / name
    write_cloud(path, cloud(20_000))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(InputError, match=rf"{name}.*(cut|not a LAS)"):
        list(cloud_parts(path, (), 1000))


def test_clouds_written_one_after_another_are_one_file(tmp_path):
    parts = [cloud(30, 1), cloud(50, 2)]
    write_ply_parts(tmp_path / "a.ply", iter(parts), 80)
    with las_stream(tmp_path / "a.laz", unit_intensity=False) as stream:
        for part in parts:
            stream.append(part)
    world = np.concatenate([part.world() for part in parts])
    assert read_cloud(tmp_path / "a.ply").world() == pytest.approx(world, abs=1e-9)
    assert read_cloud(tmp_path / "a.laz").world() == pytest.approx(world, abs=1e-3)


def test_a_dim_first_part_does_not_set_the_scale_of_intensity(tmp_path):
    dim = cloud(5).with_fields(intensity=np.full(5, 0.5, np.float32))
    with las_stream(tmp_path / "a.laz", unit_intensity=False) as stream:
        stream.append(dim)
        stream.append(cloud(5, 2).with_fields(intensity=np.full(5, 90.0, np.float32)))
    assert read_cloud(tmp_path / "a.laz").fields["intensity"][5:].tolist() == [90] * 5


def test_parts_that_differ_or_do_not_add_up_leave_no_ply(tmp_path):
    path = tmp_path / "a.ply"
    for parts, count in (([cloud(3)], 4), ([cloud(3), cloud(3).with_fields(extra=np.zeros(3))], 6), ([], 0)):
        with pytest.raises(InputError, match=r"a\.ply"):
            write_ply_parts(path, iter(parts), count)
        assert not path.exists()


@settings(max_examples=20, deadline=None)
@given(count=st.integers(0, 50), size=st.integers(1, 60))
def test_parts_of_a_visibility_layer_are_the_whole_in_order(tmp_path_factory, count, size):
    path = tmp_path_factory.mktemp("beams") / "visibility.npz"
    rng = np.random.default_rng(count)
    grid = VisibilityGrid(
        ORIGIN, 0.5, np.sort(rng.choice(10**9, count, replace=False)),
        rng.integers(0, 9, count).astype(np.uint32), rng.integers(0, 9, count).astype(np.uint32),
    )  # fmt: skip
    save_visibility(path, grid)
    whole, parts = load_visibility(path), list(visibility_parts(path, size))
    for name in ("keys", "hits", "passes"):
        joined = np.concatenate([np.zeros(0, np.int64), *(getattr(part, name) for part in parts)])
        assert joined.tolist() == getattr(whole, name).tolist()
    assert all(part.voxel == 0.5 and np.array_equal(part.origin, ORIGIN) for part in parts)


def test_a_damaged_visibility_layer_is_named(tmp_path):
    path = tmp_path / "visibility.npz"
    path.write_bytes(b"PK\x03\x04 not a layer")
    with pytest.raises(InputError, match=r"visibility\.npz: not a visibility layer"):
        list(visibility_parts(path))


def test_an_opened_map_is_the_loaded_one(tmp_path):
    write_map(tmp_path / "map", SurveyMap(cloud(100)))
    opened, loaded = open_epoch(tmp_path / "map"), load_epoch(tmp_path / "map")
    assert opened.crs == loaded.crs
    assert opened.origin.tolist() == loaded.cloud.origin.tolist()
    assert opened.info == loaded.info
    assert opened.trajectory is None
    assert not opened.has_beams
    world = np.concatenate([part.world() for part in opened.clouds(("intensity",))])
    assert world == pytest.approx(loaded.cloud.world(), abs=1e-9)


def test_a_map_whose_cloud_has_another_crs_is_refused(tmp_path):
    write_map(tmp_path / "map", SurveyMap(cloud(100)))
    text = (tmp_path / "map" / "map.yaml").read_text()
    (tmp_path / "map" / "map.yaml").write_text(text.replace("EPSG:7850", "EPSG:7851"))
    with pytest.raises(InputError, match="EPSG:7851, the cloud says EPSG:7850"):
        open_epoch(tmp_path / "map")

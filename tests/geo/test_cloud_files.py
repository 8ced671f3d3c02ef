"""Cloud files: round trips, every form of PLY and PCD, and refusals in one line."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud, from_world
from subiaco_geo.errors import InputError

MGA = "EPSG:7850"
PERTH = np.array([389_000.0, 6_463_000.0, 10.0])
PLY_TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
PLY_NAMES = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]


def street(n: int = 500, crs: str | None = MGA) -> PointCloud:
    """A cloud with the fields of a map, seed 7."""
    rng = np.random.default_rng(7)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return from_world(
        PERTH + rng.uniform(0, 300, (n, 3)),
        crs,
        intensity=rng.integers(0, 3000, n).astype(np.float32),
        normals=normals,
        n=rng.integers(1, 90, n).astype(np.int32),
        spread=rng.uniform(0, 1, n).astype(np.float32),
        red=rng.integers(0, 256, n).astype(np.uint8),
        green=rng.integers(0, 256, n).astype(np.uint8),
        blue=rng.integers(0, 256, n).astype(np.uint8),
    )


def assert_refused(path: Path, match: str) -> None:
    """Check that a file is refused in one line that names it."""
    with pytest.raises(InputError, match=match) as caught:
        read_cloud(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


# --- PLY -------------------------------------------------------------------------------------------


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    n = draw(st.integers(1, 30))
    xyz = draw(hnp.arrays(np.float64, (n, 3), elements=st.floats(-1e7, 1e7, width=64)))
    fields = {
        f"field{i}": draw(hnp.arrays(np.dtype(kind), n))
        for i, kind in enumerate(draw(st.lists(st.sampled_from(PLY_TYPES), max_size=4)))
    }
    if draw(st.booleans()):
        fields["normals"] = draw(hnp.arrays(np.float32, (n, 3), elements=st.floats(-1, 1, width=32)))
    return from_world(xyz, draw(st.sampled_from([None, MGA])), **fields)


@given(clouds())
def test_ply_keeps_every_bit_of_coordinates_and_fields(
    tmp_path_factory: pytest.TempPathFactory, cloud: PointCloud
) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_cloud(path, cloud)
    back = read_cloud(path)
    np.testing.assert_array_equal(back.world(), from_world(cloud.world()).world())
    assert back.crs == cloud.crs
    assert set(back.fields) == set(cloud.fields)
    for name, values in cloud.fields.items():
        assert back.fields[name].dtype == values.dtype
        np.testing.assert_array_equal(back.fields[name], values)


def test_ply_world_coordinates_are_doubles_on_disk(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", street())
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
    assert "property double x\nproperty double y\nproperty double z\n" in header
    assert "comment crs EPSG:7850" in header
    assert "property float spread" in header
    assert "property double nx" in header


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_any_property_type_is_read_in_any_byte_order(tmp_path: Path, order: str) -> None:
    names = ["x", "y", "z", *(f"p_{kind}" for kind in PLY_TYPES)]
    kinds = ["f8", "f8", "f8", *PLY_TYPES]
    mark = ">" if order == "binary_big_endian" else "<"
    table = np.zeros(3, dtype=[(n, mark + k) for n, k in zip(names, kinds, strict=True)])
    for i, name in enumerate(names):
        table[name] = np.arange(3) + i
    spoken = dict(zip(PLY_TYPES, PLY_NAMES, strict=True))
    header = [f"property {spoken[k]} {n}" for n, k in zip(names, kinds, strict=True)]
    text = "\n".join(["ply", f"format {order} 1.0", "element vertex 3", *header, "end_header", ""])
    if order == "ascii":
        body = "\n".join(" ".join(str(v) for v in row) for row in table.tolist()).encode()
    else:
        body = table.tobytes()
    path = tmp_path / "a.ply"
    path.write_bytes(text.encode() + body)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.world(), [[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    for i, kind in enumerate(PLY_TYPES):
        values = cloud.fields[f"p_{kind}"]
        assert values.dtype == np.dtype(kind)
        np.testing.assert_array_equal(values, np.arange(3) + i + 3)


def ascii_ply(
    path: Path, rows: str, count: int, kind: str = "float", extra: str = "", comment: str = ""
) -> Path:
    path.write_text(
        f"ply\nformat ascii 1.0\n{comment}element vertex {count}\nproperty {kind} x\nproperty {kind} y\n"
        f"property {kind} z\n{extra}end_header\n{rows}"
    )
    return path


def test_faces_after_the_vertices_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    ascii_ply(path, "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", 3, extra="element face 1\nproperty list uchar int v\n")
    assert len(read_cloud(path)) == 3


def test_the_prefix_of_cloudcompare_is_dropped(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", "0 0 0 4\n", 1, extra="property uchar scalar_change\n")
    np.testing.assert_array_equal(read_cloud(path).fields["change"], [4])


def test_digits_written_beyond_float_in_ascii_are_kept(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", "389000.123 6463000.456 10.5\n", 1)
    np.testing.assert_allclose(read_cloud(path).world(), [[389000.123, 6463000.456, 10.5]], atol=1e-9)


def test_a_field_called_crs_is_a_field(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", "0 0 0 4\n", 1, extra="property uchar crs\n")
    np.testing.assert_array_equal(read_cloud(path).fields["crs"], [4])


@pytest.mark.parametrize("suffix", [".ply", ".laz", ".las"])
@pytest.mark.parametrize("keep", [0.0, 0.01, 0.4, 0.95])
def test_a_truncated_file_is_refused(tmp_path: Path, suffix: str, keep: float) -> None:
    path = tmp_path / f"a{suffix}"
    write_cloud(path, street())
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    assert_refused(path, "cut|no bytes|not a PLY|not a LAS")


def test_a_truncated_ascii_ply_says_how_many_points_are_there(tmp_path: Path) -> None:
    assert_refused(ascii_ply(tmp_path / "a.ply", "0 0 0\n1 1 1\n", 3), "cut: 2 of 3 points")


@pytest.mark.parametrize(
    ("header", "match"),
    [
        ("plx\n", "not a PLY"),
        ("ply\nformat binary_middle_endian 1.0\nend_header\n", "not known"),
        ("ply\nelement vertex 1\nproperty float x\nend_header\n", "no format"),
        ("ply\nformat ascii 1.0\nelement vertex many\n", "makes no sense"),
        ("ply\nformat ascii 1.0\nproperty float x\n", "makes no sense"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n", "unknown type 'quad'"),
        ("ply\nformat ascii 1.0\nelement face 1\nproperty float a\nend_header\n1\n", "no vertices"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1 1\n", "list"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n",
            "twice",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n",
            "no coordinate z",
        ),
    ],
)
def test_a_header_that_makes_no_sense_is_refused(tmp_path: Path, header: str, match: str) -> None:
    path = tmp_path / "a.ply"
    path.write_text(header)
    assert_refused(path, match)


@pytest.mark.parametrize(
    ("rows", "match"), [("0 0 zero\n", "cannot be read"), ("0 0 0 0\n", "rows of 4 numbers for 3 properties")]
)
def test_rows_that_do_not_fit_are_refused(tmp_path: Path, rows: str, match: str) -> None:
    assert_refused(ascii_ply(tmp_path / "a.ply", rows, 1), match)


def test_numbers_that_do_not_fit_their_type_are_refused(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", "0 0 0 300\n", 1, extra="property uchar change\n")
    assert_refused(path, "change has values outside uchar")


def test_integers_that_ply_cannot_hold_are_refused(tmp_path: Path) -> None:
    cloud = PointCloud(np.zeros((1, 3)), fields={"t": np.array([1_763_000_000_000_000_000])})
    with pytest.raises(InputError, match="field t has integers that PLY cannot hold"):
        write_cloud(tmp_path / "a.ply", cloud)


# --- LAS / LAZ -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".laz", ".las"])
def test_laz_keeps_millimetres_fields_and_crs(tmp_path: Path, suffix: str) -> None:
    cloud = street()
    write_cloud(tmp_path / f"a{suffix}", cloud)
    back = read_cloud(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.world(), cloud.world(), atol=0.000501)
    assert back.crs == MGA
    assert set(back.fields) == set(cloud.fields)
    for name, values in cloud.fields.items():
        np.testing.assert_array_equal(back.fields[name], values)


def test_laz_is_las_1_4_with_wkt_that_states_ellipsoidal_height(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.laz", street())
    with laspy.open(tmp_path / "a.laz") as reader:
        header = reader.header
        assert str(header.version) == "1.4"
        assert header.point_format.id == 7
        assert header.global_encoding.wkt
        assert header.are_points_compressed
        (record,) = [v for v in header.vlrs if v.record_id == 2112]
        crs = header.parse_crs()
    assert record.string.startswith("COMPD_CS[")
    assert 'VERT_DATUM["GDA2020 ellipsoid",2002]' in record.string
    assert crs.axis_info[2].name == "Ellipsoidal height"
    assert crs.to_2d().to_epsg() == 7850


def test_laz_without_colours_is_point_format_6_and_without_crs_has_none(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.laz", PointCloud(np.eye(3)))
    with laspy.open(tmp_path / "a.laz") as reader:
        assert reader.header.point_format.id == 6
    assert read_cloud(tmp_path / "a.laz").crs is None


def test_intensity_between_0_and_1_is_spread_over_16_bits(tmp_path: Path) -> None:
    cloud = PointCloud(np.eye(3), fields={"intensity": np.array([0.0, 0.5, 1.0], np.float32)})
    write_cloud(tmp_path / "a.laz", cloud)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.laz").fields["intensity"], [0, 32768, 65535])


def test_classification_outside_a_byte_is_refused(tmp_path: Path) -> None:
    cloud = PointCloud(np.eye(3), fields={"classification": np.array([-1, 0, 1])})
    with pytest.raises(InputError, match="classification must lie within 0-255"):
        write_cloud(tmp_path / "a.laz", cloud)


def test_text_called_laz_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    path.write_text("x y z\n1 2 3\n" * 100)
    assert_refused(path, "not a LAS/LAZ")


def test_flipped_bytes_in_a_laz_do_not_pass_as_points(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_cloud(path, street())
    data = bytearray(path.read_bytes())
    with laspy.open(path) as reader:
        start = reader.header.offset_to_point_data
    data[start : start + 8] = struct.pack("<q", 2**62)  # where the chunk table is said to be
    path.write_bytes(data)
    assert_refused(path, "cut or not a LAS")


def test_real_lidar_hd_tiles_are_read_with_crs_and_classes(shared_data: Path) -> None:
    cloud = read_cloud(shared_data / "ign_lidarhd" / "test_data_77055_627755_LA93_IGN69.laz")
    assert len(cloud) == 72_770
    assert cloud.crs == "EPSG:2154"
    assert {2, 6} <= set(np.unique(cloud.fields["classification"]).tolist())
    assert cloud.fields["red"].dtype == np.uint8
    np.testing.assert_allclose(cloud.world().mean(axis=0)[:2], [770_575, 6_277_575], atol=50)


def test_real_oregon_cloud_without_crs_is_read(shared_data: Path) -> None:
    cloud = read_cloud(shared_data / "autzen" / "autzen_crop_650x300m_rgb.laz")
    assert len(cloud) == 1_572_976
    assert cloud.crs is None
    assert np.abs(cloud.xyz).max() < 1000.0


# --- what every form refuses -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".laz"])
def test_an_empty_cloud_is_neither_written_nor_read(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="the cloud is empty"):
        write_cloud(tmp_path / f"a{suffix}", PointCloud(np.zeros((0, 3))))
    assert list(tmp_path.iterdir()) == []


def test_empty_files_of_each_form_are_refused(tmp_path: Path) -> None:
    assert_refused(ascii_ply(tmp_path / "a.ply", "", 0), "the cloud is empty")
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(tmp_path / "c.las")
    assert_refused(tmp_path / "c.las", "the cloud is empty")


@pytest.mark.parametrize("bad", ["nan", "inf"])
def test_coordinates_that_are_not_numbers_are_counted_and_refused(tmp_path: Path, bad: str) -> None:
    rows = f"0 0 0\n{bad} 0 0\n0 0 {bad}\n"
    assert_refused(
        ascii_ply(tmp_path / "a.ply", rows, 3), "2 of 3 points have NaN or infinite coordinates; remove"
    )
    cloud = PointCloud(np.array([[0.0, 0.0, float(bad)]]))
    for suffix in (".ply", ".laz"):
        with pytest.raises(InputError, match="1 of 1 points"):
            write_cloud(tmp_path / f"b{suffix}", cloud)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_projected_coordinates_in_float32_are_refused_with_the_remedy(tmp_path: Path, form: str) -> None:
    xyz = (PERTH + np.random.default_rng(5).uniform(0, 99, (20, 3))).astype(np.float32)
    text = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in xyz)
    path = ascii_ply(tmp_path / "a.ply", text, 20)
    if form != "ascii":
        header = path.read_bytes().split(b"end_header\n")[0].replace(b"ascii", form.encode())
        path.write_bytes(header + b"end_header\n" + xyz.astype("<f4").tobytes())
    assert_refused(path, "float32, which steps by .* m; export again with double")


def test_local_coordinates_in_float32_are_welcome(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", "1.5 2.5 3.5\n", 1)
    np.testing.assert_array_equal(read_cloud(path).xyz, [[1.5, 2.5, 3.5]])


def test_an_unknown_crs_in_a_ply_is_refused(tmp_path: Path) -> None:
    path = ascii_ply(tmp_path / "a.ply", "1 2 3\n", 1, comment="comment crs EPSG:99999\n")
    assert_refused(path, "'EPSG:99999': not known; give an EPSG code")
    for suffix in (".ply", ".laz"):
        with pytest.raises(InputError, match="not known"):
            write_cloud(tmp_path / f"b{suffix}", PointCloud(np.eye(3), crs="EPSG:99999"))


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.laz"])
def test_heights_in_feet_are_refused_with_their_unit(tmp_path: Path, name: str) -> None:
    """Metres in plan and feet in height: NAD83 / UTM zone 10N with NAVD88 heights in US survey feet."""
    cloud = PointCloud(np.ones((3, 3)), np.array([5e5, 5e6, 0.0]), "EPSG:26910+6360")
    with pytest.raises(InputError, match=f"{name}: its CRS gives heights in US survey foot; convert"):
        write_cloud(tmp_path / name, cloud)
    assert not (tmp_path / name).exists()
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x, las.y, las.z = np.full(3, 5e5), np.full(3, 5e6), np.ones(3)
    las.header.add_crs(CRS("EPSG:26910+6360"))
    las.write(tmp_path / "feet.las")
    with pytest.raises(InputError, match=r"feet.las: its CRS gives heights in US survey foot; convert"):
        read_cloud(tmp_path / "feet.las")


def test_an_unreadable_crs_in_a_laz_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    write_cloud(path, street())
    path.write_bytes(path.read_bytes().replace(b'COMPD_CS["GDA', b'COMPD_XS["GDA'))
    assert_refused(path, "CRS record cannot be understood")


def written_with_wkt(path: Path, wkt: str, shift: float) -> Path:
    """LAS file whose WKT record holds a text, with points around a coordinate [m]."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.full(3, shift)
    header.vlrs.append(WktCoordinateSystemVlr(wkt))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (shift + np.arange(4.0) for _ in range(3))
    las.write(str(path))
    return path


def test_metres_under_a_crs_of_degrees_are_read_without_that_crs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A writer that knew no better called UTM coordinates WGS 84."""
    path = written_with_wkt(tmp_path / "utm.las", CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), 515_368.0)
    cloud = read_cloud(path)
    assert cloud.crs is None
    assert cloud.world()[0].tolist() == [515_368.0] * 3
    assert "'WGS 84' has coordinates in degrees, but coordinates of the file reach 515371" in caplog.text


def test_metres_under_a_geocentric_crs_are_read_without_that_crs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = written_with_wkt(tmp_path / "utm.las", CRS.from_epsg(4978).to_wkt("WKT1_GDAL"), 515_368.0)
    assert read_cloud(path).crs is None
    assert "the points lie 893 km from there" in caplog.text


def test_geocentric_coordinates_are_refused_as_no_map(tmp_path: Path) -> None:
    wkt = CRS.from_epsg(4978).to_wkt("WKT1_GDAL").replace("WGS 84", "unnamed", 1)
    path = written_with_wkt(tmp_path / "ecef.las", wkt, 6_371_000.0 / 3**0.5)
    assert_refused(path, "not a projected system")


def test_degrees_are_refused_as_no_map(tmp_path: Path) -> None:
    path = written_with_wkt(tmp_path / "degrees.las", CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), 46.0)
    assert_refused(path, "not a projected system")


@pytest.mark.parametrize("blank", ["", "''", '""', " \n"])
def test_a_crs_record_that_says_nothing_is_no_crs(tmp_path: Path, blank: str) -> None:
    assert read_cloud(written_with_wkt(tmp_path / "blank.las", blank, 1000.0)).crs is None


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none.ply", "no such cloud file; give a .ply")


@pytest.mark.parametrize("name", ["a.txt", "a", "a.e57"])
def test_an_unknown_ending_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    assert_refused(tmp_path / name, "cannot read clouds of type")
    with pytest.raises(InputError, match="cannot write clouds of type"):
        write_cloud(tmp_path / name, street())


def test_a_field_name_with_a_space_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'two words' cannot be written"):
        write_cloud(tmp_path / "a.ply", PointCloud(np.eye(3), fields={"two words": np.zeros(3)}))


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_cloud(path, street())
    before = path.read_bytes()
    with pytest.raises(InputError):
        write_cloud(path, PointCloud(np.full((1, 3), np.nan)))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]

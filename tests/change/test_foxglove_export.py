"""A finished comparison in one MCAP file: read back by the mcap library with the schemas that it holds."""

from __future__ import annotations

import json
from collections import defaultdict

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from subiaco_change.outputs import foxglove
from subiaco_change.outputs.clouds import read_labelled
from subiaco_change.outputs.exports import export_changes
from subiaco_change.outputs.reviews import read_reviewed
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError

POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("change", "u1"), ("semantic", "u1"),
     ("instance", "<i4"), ("confidence", "<f4"), ("lod95", "<f4")]
)  # fmt: skip


def opened(path):
    """Messages by topic, ROS 2 ones decoded by the definitions in the file, JSON ones checked by theirs."""
    found = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                value = json.loads(message.data)
                jsonschema.validate(value, json.loads(schema.data))
            else:
                assert schema.encoding == "ros2msg"
                value = DecoderFactory().decoder_for("cdr", schema)(message.data)
            found[channel.topic].append(value)
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    return found, metadata["subiaco"]


@pytest.fixture(scope="module")
def exported(change_directory, tmp_path_factory):
    (file,) = export_changes(change_directory, tmp_path_factory.mktemp("foxglove") / "out", "foxglove")
    assert file.name == "changes.mcap"
    return opened(file)


def test_every_point_has_its_labels_and_lies_in_the_local_frame(exported, change_directory):
    topics, facts = exported
    for epoch in ("before", "after"):
        (message,) = topics[f"/change/{epoch}"]
        cloud = read_labelled(change_directory, epoch)
        points = np.frombuffer(bytes(message.data), POINT)
        assert message.header.frame_id == "map"
        assert [field.name for field in message.fields] == list(POINT.names)
        assert len(points) == message.width == len(cloud) == int(facts[f"{epoch}_points"])
        np.testing.assert_array_equal(points["change"], cloud.fields["change"])
        np.testing.assert_array_equal(points["instance"], cloud.fields["instance"])
        world, local = cloud.world(), np.stack([points[n] for n in "xyz"], axis=1).astype(np.float64)
        assert np.abs(local).max() < 1e4
        # The grid of the map and true east and north differ by a scale and a turn alone.
        spread = np.linalg.norm(world - world[0], axis=1)
        np.testing.assert_allclose(np.linalg.norm(local - local[0], axis=1), spread, rtol=1e-3, atol=0.01)


def test_the_table_holds_every_row_with_the_schema_of_the_columns(exported, change_directory):
    topics, facts = exported
    (value,) = topics["/change/table"]
    stored = read_reviewed(change_directory)
    assert value["crs"] == facts["crs"] == "EPSG:7850"
    assert [row["object_id"] for row in value["records"]] == stored["object_id"].tolist()
    assert [row["label"] for row in value["records"]] == stored["label"].tolist()


def test_every_changed_object_has_an_outline_and_a_label_at_its_place(exported, change_directory):
    topics, _ = exported
    (array,) = topics["/change/markers"]
    stored = read_reviewed(change_directory).set_index("object_id")
    lines = {m.id: m for m in array.markers if m.ns == "objects"}
    changed = stored[stored["label"].isin(["Added", "Removed", "Increased", "Decreased"])]
    points = np.concatenate(
        [np.frombuffer(bytes(topics[f"/change/{epoch}"][0].data), POINT) for epoch in ("before", "after")]
    )
    with_points = set(changed.index) & set(points["instance"].tolist())
    assert set(lines) == {m.id for m in array.markers if m.ns == "labels"} == with_points
    for number, marker in lines.items():
        corners = np.array([[p.x, p.y, p.z] for p in marker.points])
        mine = points[points["instance"] == number]
        assert corners[:, 2].min() == pytest.approx(mine["z"].min())
        assert corners[:, 2].max() == pytest.approx(mine["z"].max())
        assert abs(corners[:, 0].mean() - mine["x"].mean()) < 10.0


def test_footprints_lie_in_longitude_and_latitude_and_frames_are_connected(exported):
    topics, _ = exported
    shapes = json.loads(topics["/change/footprints"][0]["geojson"])
    assert shapes["features"]
    for feature in shapes["features"]:
        longitude, latitude = np.array(feature["geometry"]["coordinates"][0][0]).reshape(-1, 2)[0]
        assert 115 < longitude < 117
        assert -33 < latitude < -31
    origin = topics["/change/origin"][0]
    assert -33 < origin.latitude < -31
    assert {t.child_frame_id for m in topics["/tf_static"] for t in m.transforms} == {"map"}


def test_a_large_cloud_keeps_its_changed_points_and_is_thinned_evenly(
    change_directory, tmp_path, monkeypatch
):
    cloud = read_labelled(change_directory, "after")
    changed = int((cloud.fields["change"] < Change.UNCHANGED).sum())
    monkeypatch.setattr(foxglove, "MOST_POINTS", changed + (len(cloud) - changed) // 3)
    (file,) = export_changes(change_directory, tmp_path / "out", "foxglove")
    topics, facts = opened(file)
    points = np.frombuffer(bytes(topics["/change/after"][0].data), POINT)
    assert (points["change"] < Change.UNCHANGED).sum() == changed
    assert len(points) <= foxglove.MOST_POINTS + 1
    assert int(facts["after_points_of"]) == len(cloud) > len(points)


def test_a_folder_that_is_no_comparison_is_refused(tmp_path):
    with pytest.raises(InputError, match="not the output of 'subiaco change'"):
        export_changes(tmp_path, tmp_path / "out", "foxglove")

"""The 3D viewer: octrees that hold every point once, and a page that a browser draws without a network."""

import base64
import functools
import gzip
import http.server
import json
import queue
import re
import shutil
import subprocess
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_change.outputs.clouds import read_labelled
from subiaco_geo.codes import CHANGED_LABELS
from subiaco_report import page
from subiaco_report.viewer import build, octree
from subiaco_report.viewer.build import build_viewer, update_viewer, viewer_link
from subiaco_report.viewer.octree import GRID, NodeKey, RootCube, nodes_of

ACTIONS = Path(__file__).with_name("viewer_actions.js")
WIDTHS = {"x": 2, "y": 2, "z": 2, "object": 4, "change": 1, "class": 1, "intensity": 1, "confidence": 1}


def data_of(viewer):
    text = re.search(r'subiacoViewerData\("([^"]*)"\)', (viewer / "data.js").read_text()).group(1)
    return json.loads(gzip.decompress(base64.b64decode(text)))


def node_of(path, count):
    """Columns of a node file, read by the table of its documentation."""
    cloud, name, text = re.fullmatch(
        r'subiacoNode\("(\w+)","(r\d*)","([^"]*)"\);\n', path.read_text()
    ).groups()
    assert (cloud, name) == (path.parent.name, path.stem)
    raw = np.frombuffer(zlib.decompress(base64.b64decode(text), 31), dtype=np.uint8)
    found, at = {}, 0
    for column, width in WIDTHS.items():
        planes = raw[at : at + width * count].reshape(width, count).astype(np.int64)
        found[column] = sum(plane << (8 * k) for k, plane in enumerate(planes))
        at += width * count
    assert at == len(raw)
    return found


def points_of(viewer, epoch):
    """World coordinates, object and change of all points that the files of an epoch hold."""
    data = data_of(viewer)
    xyz, objects, change = [], [], []
    for name, count in data["clouds"][epoch]["nodes"]:
        columns = node_of(viewer / epoch / f"{name}.js", count)
        corner, edge = np.array(data["corner"], dtype=float), data["size"]
        for octant in map(int, name[1:]):
            edge /= 2
            corner = corner + edge * np.array([octant >> 2, octant >> 1 & 1, octant & 1])
        steps = np.stack([columns[axis] for axis in "xyz"], axis=1)
        xyz.append(corner + (steps + 0.5) * edge / 65536)
        objects.append(columns["object"] - 1)
        change.append(columns["change"])
    return np.concatenate(xyz), np.concatenate(objects), np.concatenate(change)


def sorted_rows(*columns):
    rows = np.column_stack(columns)
    return rows[np.lexsort(rows.T[::-1])]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(1, 3000), first_level=st.integers(0, 3))
def test_every_point_is_in_one_node_and_inside_its_cube(seed, count, first_level):
    rng = np.random.default_rng(seed)
    unit = np.concatenate([rng.random((count, 3)), np.repeat(rng.random((1, 3)), 20, axis=0)])
    held = list(nodes_of(unit, rng.random(len(unit)) < 0.1, first_level))
    assert np.array_equal(np.sort(np.concatenate([index for _, index in held])), np.arange(len(unit)))
    assert len({key for key, _ in held}) == len(held)
    for key, index in held:
        low = np.array([key.x, key.y, key.z]) / 2**key.level
        assert (unit[index] >= low).all()
        assert (unit[index] < low + 1 / 2**key.level).all()


def test_a_crowded_node_holds_one_point_a_cell_and_prefers_changed_ones(monkeypatch):
    monkeypatch.setattr(octree, "CAPACITY", 500)
    rng = np.random.default_rng(3)
    unit = rng.random((60_000, 3)) * [1.0, 1.0, 0.02]
    changed = rng.random(len(unit)) < 0.05
    root = next(index for key, index in nodes_of(unit, changed, 0) if key.level == 0)
    cells = np.floor(unit * GRID).astype(int) @ [GRID**2, GRID, 1]
    assert len(np.unique(cells[root])) == len(root)
    with_change = np.isin(cells[root], np.unique(cells[changed]))
    assert 0 < with_change.sum() < len(root)
    assert np.array_equal(changed[root], with_change)


def test_names_of_nodes_are_paths_of_octants():
    assert NodeKey(0, 0, 0, 0).name() == "r"
    assert NodeKey(3, 0b101, 0b011, 0b110).name() == "r536"
    assert RootCube.around(np.array([10.2, 20.9, -1.5]), np.array([29.9, 21.0, 4.0])).size == 20.0


@pytest.fixture(scope="module")
def viewer(change_directory):
    """The folder as 'subiaco change' leaves it."""
    return change_directory / "viewer"


@pytest.mark.parametrize("epoch", ["before", "after"])
def test_the_files_hold_every_labelled_point_where_it_is(viewer, change_directory, epoch):
    cloud = read_labelled(change_directory, epoch)
    xyz, objects, change = points_of(viewer, epoch)
    assert len(xyz) == len(cloud) == data_of(viewer)["clouds"][epoch]["points"]
    step = data_of(viewer)["size"] / 65536
    assert np.abs(np.sort(xyz, axis=0) - np.sort(cloud.world(), axis=0)).max() <= step
    assert np.array_equal(np.bincount(objects + 1), np.bincount(np.asarray(cloud.fields["instance"]) + 1))
    assert np.array_equal(np.bincount(change), np.bincount(np.asarray(cloud.fields["change"])))


def test_columns_of_a_large_cloud_hold_the_same_points(viewer, change_directory, tmp_path, monkeypatch):
    shutil.copytree(change_directory, tmp_path / "copy")
    monkeypatch.setattr(build, "column_level", lambda _: 2)
    cut = build_viewer(tmp_path / "copy").parent
    for epoch in ("before", "after"):
        whole, parts = (sorted_rows(*points_of(folder, epoch)) for folder in (viewer, cut))
        assert len(whole) == len(parts)
        assert np.array_equal(np.sort(whole[:, 3]), np.sort(parts[:, 3]))
        assert np.abs(np.sort(whole[:, :3], axis=0) - np.sort(parts[:, :3], axis=0)).max() < 0.01


def test_rows_have_the_box_of_their_points_and_changed_ones_come_first(viewer, change_directory, result):
    data = data_of(viewer)
    rows = data["rows"]
    assert sorted(rows["object_id"]) == sorted(r.object_id for r in result.records)
    changed = [label in CHANGED_LABELS for label in rows["label"]]
    assert changed == sorted(changed, reverse=True)
    k = rows["object_id"].index(2)
    cloud = read_labelled(change_directory, "before")
    own = cloud.world()[np.asarray(cloud.fields["instance"]) == 2] - data["corner"]
    assert np.allclose(rows["box"][k], [*own.min(axis=0), *own.max(axis=0)], atol=0.02)
    assert {entry["label"]: entry["code"] for entry in data["labels"]}["Unobserved"] == 255
    assert all(entry["safe"] for entry in data["labels"])


def test_the_library_is_small_and_its_licence_lies_beside_it(viewer):
    assert "MIT licence" in (viewer / "three.min.js").read_text()[:200]
    assert (viewer / "three.LICENSE.txt").read_text().startswith("The MIT License")
    scripts = sum(path.stat().st_size for path in viewer.glob("*.js") if path.name != "data.js")
    assert scripts < 1_500_000


def test_the_report_links_every_changed_row_to_the_viewer(change_directory):
    html = (change_directory / "report.html").read_text()
    assert '<a href="viewer/index.html">3D view</a>' in html
    packed = re.search(r'id="data">([^<]*)<', html).group(1)
    assert json.loads(gzip.decompress(base64.b64decode(packed)))["viewer"] == "viewer/index.html"


def test_large_clouds_get_a_viewer_only_when_it_is_asked_for(change_directory, tmp_path, monkeypatch):
    copy = shutil.copytree(change_directory, tmp_path / "copy")
    shutil.rmtree(copy / "viewer")
    monkeypatch.setattr(build, "AUTOMATIC_POINTS", 10)
    assert update_viewer(copy) is None
    page.build_report(copy)
    assert "3D view</a>" not in (copy / "report.html").read_text().split("<script")[0]
    build_viewer(copy)
    assert viewer_link(copy) == "viewer/index.html"
    assert update_viewer(copy) == copy / "viewer" / "index.html"


needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on PATH")
BROWSER = [
    "chromium",
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--remote-debugging-port=0",
    "--window-size=900,600",
]


class Listener(http.server.SimpleHTTPRequestHandler):
    """Serves a folder as ``python -m http.server`` does, and keeps what a page posts."""

    def __init__(self, *args, heard, **kwargs):
        self.heard = heard
        super().__init__(*args, **kwargs)

    def do_POST(self):
        self.heard.put(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *args):
        pass


def act(directory, tmp_path, served, row):
    """Open the viewer in headless Chromium, act on it, and return what the page saw."""
    heard: queue.Queue[bytes] = queue.Queue()
    handler = functools.partial(Listener, directory=str(directory), heard=heard)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    base = f"http://127.0.0.1:{server.server_port}"
    page = directory / "viewer" / "index.html"
    script = ACTIONS.read_text().replace("__SAY__", f"{base}/said").replace("__ROW__", str(row))
    page.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
    address = f"{base}/viewer/index.html" if served else page.as_uri()
    browser = subprocess.Popen(
        [*BROWSER, f"--user-data-dir={tmp_path / 'profile'}", address],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        return json.loads(heard.get(timeout=150))
    finally:
        browser.terminate()
        browser.wait(20)
        server.shutdown()
        server.server_close()


@needs_chromium
@pytest.mark.parametrize("served", [False, True], ids=["from the file system", "from a web server"])
def test_in_a_browser_both_surveys_are_drawn_swiped_and_picked(change_directory, tmp_path, served):
    copy = Path(shutil.copytree(change_directory, tmp_path / "copy"))
    said = act(copy, tmp_path, served, row=2)
    if "WebGL" in said["failed"]:
        pytest.skip(f"no WebGL in this Chromium: {said['failed']}")
    assert "error" not in said, said["error"]
    assert said["start"]["mode"] == "swipe"
    assert said["start"]["points"] > 20_000
    assert said["start"]["missing"] == 0
    assert min(said["whole"]["lit"]) > 500  # both halves show points
    assert said["whole"]["colours"] > 50
    assert said["allAfter"]["hash"] == said["after"]["hash"]  # the border at the edge shows one survey alone
    assert said["allBefore"]["hash"] == said["before"]["hash"]
    assert len({said[name]["hash"] for name in ("whole", "before", "after")}) == 3
    first = data_of(copy / "viewer")["rows"]["object_id"][0]
    assert said["clicked"]["chosen"] == first
    assert said["clicked"]["target"] != said["start"]["target"]  # the camera flew there
    assert f"Object {first}" in said["card"]
    assert f"rule {first}:" in said["card"]
    assert said["hash"] == f"#object-{first}"
    assert said["closed"] is None
    assert said["hit"] == said["picked"] == 2  # the point in the middle of the picture is of the house
    assert said["selected"] == "2"
    assert len(set(said["colours"].values())) == 6
    assert "mode=both&colour=survey" in said["link"]
    assert "could not be loaded" not in said["status"]

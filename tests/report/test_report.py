"""The report is complete, stands alone, and opens in a browser without a network."""

import base64
import gzip
import io
import json
import re
import shutil
import subprocess
import time
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from result_scene import ORIGIN, SceneConfig
from shapely.geometry import box

from subiaco_change.config import ChangeConfig
from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_change.outputs.rasters import Coverage
from subiaco_change.outputs.reviews import read_review_file
from subiaco_geo.codes import CHANGED_LABELS, Change
from subiaco_geo.config import load_config, write_config
from subiaco_geo.errors import InputError
from subiaco_geo.findings import Finding
from subiaco_report import evidence_pictures as evidence
from subiaco_report import page as report_page
from subiaco_report import pictures
from subiaco_report.facts import least_observed, number, summary, unseen_facts
from subiaco_report.page import TABLE_COLUMNS, build_report, fullest_blocks

VOID = {"meta", "img", "input", "br", "link", "hr"}


class Page(HTMLParser):
    """Collects what the tests ask about, and checks that tags close."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.images, self.links, self.ids, self.open, self.text = {}, [], [], set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        if "id" in named:
            assert named["id"] not in self.ids, f"id {named['id']} twice"
            self.ids.add(named["id"])
        if tag == "tr" and "data-object-id" in named:
            self.rows[int(named["data-object-id"])] = named
        if tag == "img":
            self.images.append(named)
        if tag == "a":
            self.links.append(named["href"])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def unpacked(html):
    """What the script of a page works on."""
    packed = re.search(r'id="data">([^<]*)<', html).group(1)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def inner_chunks(html):
    """Pictures by object id that stand in the page."""
    found = re.findall(
        r'<script type="application/json" id="chunk-\d+">(.*?)</script>', html, flags=re.DOTALL
    )
    return {int(k): v for chunk in found for k, v in json.loads(chunk).items()}


@pytest.fixture(scope="module")
def data(html):
    return unpacked(html)


@pytest.fixture(scope="module")
def html(change_directory):
    return (change_directory / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(html):
    return Page(html)


def test_every_row_of_the_table_is_there_and_changed_ones_come_first(data, result):
    rows = data["rows"]
    labels = dict(zip(rows["object_id"], rows["label"], strict=True))
    assert labels == {r.object_id: r.change.label for r in result.records}
    changed = [label in CHANGED_LABELS for label in rows["label"]]
    assert changed == sorted(changed, reverse=True)


def test_every_block_has_its_five_pictures_and_all_have_a_text_instead(html, page):
    blocks = re.findall(r'<details class="block" id="block-\w+" data-block="(\w+)"', html)
    assert blocks == ["A1", "A2"]
    for block in blocks:
        texts = [i["alt"] for i in page.images if i["alt"].startswith(f"Block {block},")]
        kinds = [text.split(", ", 1)[1].split(":")[0] for text in texts]
        assert sorted(kinds) == ["Change", "Height", "Instances", "Projection", "Semantics"]


def test_every_changed_row_carries_its_evidence_and_the_others_none(html, data, result):
    changed = {r.object_id for r in result.records if r.change.label in CHANGED_LABELS}
    proofs = inner_chunks(html)
    assert set(proofs) == changed == {int(k) for k in data["place_of"]}
    for webp, outline, ticks, *_ in proofs.values():
        assert Image.open(io.BytesIO(base64.b64decode(webp))).format == "WEBP"
        assert outline.startswith("M")
        assert len(ticks) == 2


def test_every_row_has_its_outline_on_the_map(data, result):
    west, north = ORIGIN[0], ORIGIN[1] + 70.0  # of the scene; the map begins 2 m outside the points
    boxes = dict(zip(data["rows"]["object_id"], data["rows"]["box"], strict=True))
    for record in result.records:
        left, top, right, bottom = boxes[record.object_id]
        bounds = record.footprint.bounds
        assert (right - left) * (bottom - top) == pytest.approx(record.footprint.area, rel=0.3)
        assert left - (bounds[0] - west) == pytest.approx(2.0, abs=0.3)
        assert top - (north - bounds[3]) == pytest.approx(2.0, abs=0.3)
    assert all(shape.startswith("M") and shape.endswith("Z") for shape in data["rows"]["shape"])


def test_rows_stand_from_sure_to_doubtful_with_the_reason_in_words(html, data, result):
    sure = [c for c, label in zip(data["rows"]["confidence"], data["rows"]["label"], strict=True)
            if label in CHANGED_LABELS]  # fmt: skip
    assert sure == sorted(sure, reverse=True)
    assert set(data["rows"]["reason"]) == {record.reason for record in result.records}
    headings = re.findall(
        r"<th scope=\"col\" title=[^>]*class=\"(n?)( more)?\"[^>]*><button[^>]*>([^<]*)", html
    )
    shown = [name for _, more, name in headings if not more]
    assert shown == [
        "ID", "Label", "Class", "Confidence", "Δh [m]", "ΔV [m³]", "LoD95 [m]", "Observed", "Evidence",
    ]  # fmt: skip


def test_a_city_shows_the_blocks_with_most_changes_and_says_what_is_left_out(
    change_directory, tmp_path, monkeypatch
):
    blocks = [pictures.Block(n, (x, 0, x + 1, 1), (x, 0, x + 1, 1)) for x, n in enumerate("abc")]
    marks = [pictures.Mark(x, 0.5, "") for x in (2.5, 2.6, 0.5)]
    assert [b.name for b in fullest_blocks(blocks, marks, 2)] == ["a", "c"]
    target = tmp_path / "copy"
    shutil.copytree(change_directory, target)
    monkeypatch.setattr(report_page, "_MOST_BLOCKS", 1)
    text = build_report(target).read_text()
    assert len(re.findall("<details", text)) == 1
    assert "1 blocks with fewer changes are left out" in text


def test_the_page_refers_to_nothing_outside_itself(html, page, result):
    static = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    without_pictures = re.sub(r"data:image/(png|webp);base64,[A-Za-z0-9+/=]+", "", static)
    assert not re.search(r"https?://|src=\"(?!\")[^\"]|@import|url\(", without_pictures)
    assert "http" not in "".join(re.findall(r"<script>(.*?)</script>", html, flags=re.DOTALL))
    assert all(re.match("data:image/(png|webp);base64,", image["src"]) for image in page.images)
    assert all(link.startswith("#") or link == "viewer/index.html" for link in page.links)
    rows = {f"object-{r.object_id}" for r in result.records}  # the script writes them
    assert {link[1:] for link in page.links if link.startswith("#")} <= page.ids | rows


def test_tags_close_and_texts_from_outside_are_escaped(html, page):
    assert page.open == []
    assert "<test & escape>" not in html
    assert "&lt;test &amp; escape&gt;" in html


def test_it_says_in_words_what_the_registration_and_the_detection_limit_mean(page):
    text = " ".join(" ".join(page.text).split())
    assert "2.1 cm apart" in text
    assert "93 % of the surface pairs" in text
    assert "cannot be distinguished from noise" in text
    assert "Nothing is claimed about 1 object (Unobserved)" in text
    assert "EPSG:7850" in text


def test_each_level_of_detection_says_of_what_it_is_the_median(page, change_directory):
    text = " ".join(" ".join(page.text).split())
    cells = json.loads((change_directory / "run.json").read_text())["level_of_detection"]
    assert "The median of all points is" in text
    assert f"{100.0 * cells['median_where_known_m']:.1f} cm; accuracy.html" in text
    assert "median level of detection of all points" in (change_directory / "summary.html").read_text()


def test_an_uncalibrated_confidence_is_called_so(html):
    assert "Confidence is not calibrated" in html
    assert "It is not calibrated yet" in html


def test_it_is_rebuilt_from_the_directory_alone_with_its_evaluation_and_calibration(
    change_directory, tmp_path
):
    target = tmp_path / "copy"
    shutil.copytree(change_directory, target)
    before = (target / "report.html").read_bytes()
    (target / "report.html").unlink()
    assert build_report(target).read_bytes() == before
    labels = ["Added", "Removed", "Increased", "Decreased", "Unchanged"]
    part = {"accuracy_percent": 95.0, "mf1_percent": 90.0, "miou_percent": 81.25, "miou_change_percent": 80.0}
    part |= {"abstention_percent": 1.0, "iou_percent": dict.fromkeys(labels, 80.0)}
    part |= {"f1_percent": dict.fromkeys(labels) | {"Added": 88.8}}
    document = {"truth_is_simulated": True, "labels": labels, "grid": part, "objects": None}
    (target / "evaluation.json").write_text(json.dumps(document))
    run = json.loads((target / "run.json").read_text()) | {"confidence_calibrated": True}
    (target / "run.json").write_text(json.dumps(run))
    text = build_report(target).read_text()
    assert "against simulated truth" in text
    assert "not calibrated" not in text
    assert "81.2 %" in text
    assert "88.8" in text


def test_a_directory_that_is_no_change_directory_is_refused(tmp_path):
    with pytest.raises(InputError, match="subiaco change"):
        build_report(tmp_path)


def test_numbers_are_grouped_and_missing_ones_are_a_dash():
    assert number(1234567.891, 1) == "1\u202f234\u202f567.9"
    assert number(None) == number(float("nan")) == number(np.inf) == "–"


def test_unobserved_rows_are_counted_apart_by_whether_the_other_survey_saw_enough_of_the_place(tmp_path):
    table = pd.DataFrame(
        {"label": ["Unobserved"] * 3 + ["Added"], "observed_fraction": [0.1, 0.45, 0.9, 0.0]}
    )
    coverage = Coverage(np.ones((2, 2), np.uint8), np.ones((2, 2), np.float32), 0.0, 0.0, 1.0)
    assert least_observed(tmp_path) == 0.3
    write_config(tmp_path / "config.yaml", load_config(ChangeConfig, (), ["decisions.min_observed=0.5"]))
    for least, little in ((0.3, 1), (least_observed(tmp_path), 2)):
        facts = unseen_facts(table, coverage, least)
        assert (facts["objects"], facts["little_seen"], facts["undecided"]) == (3, little, 3 - little)


def test_the_summary_counts_every_row_once():
    table = pd.DataFrame({"class": ["building", "ground"], "label": ["Added", "Increased"]})
    rows = summary(table)
    assert rows[-1]["class"] == "all"
    assert rows[-1]["total"] == 2
    assert sum(row["total"] for row in rows[:-1]) == 2


CLICKS = """
<script>
(function () {
  var said = {}, rows = function () { return document.querySelectorAll("#changes tbody tr"); };
  function set(id, value) {
    var box = document.getElementById(id);
    box.value = value; box.dispatchEvent(new Event("input"));
  }
  function ids() { return Array.prototype.map.call(rows(), function (r) { return r.dataset.objectId; }); }
  function begin() {
    if (!document.documentElement.dataset.ready) { setTimeout(begin, 20); return; }
    said.start = rows().length;
    said.histogram = document.querySelectorAll("#histogram g").length;
    set("f-label", "Added"); said.added = rows().length;
    set("f-conf", "0.7"); said.sureAdded = rows().length; set("f-conf", "0");
    set("f-label", ""); set("f-class", "building"); said.buildings = rows().length; set("f-class", "");
    set("f-size", "100"); said.large = ids(); set("f-size", "0");
    set("f-area", "100"); said.wide = ids(); set("f-area", "0");
    set("f-text", "rule 5"); said.search = ids(); set("f-text", "new car"); said.meant = ids();
    set("f-text", ""); set("f-place", "A1"); said.place = ids(); set("f-place", "");
    set("f-label", "Removed");
    location.hash = "#object-4";
    setTimeout(function () {
      said.chosen = document.querySelector("tr.chosen").dataset.objectId;
      document.querySelector("th[data-key=delta_h_m] button").click();
      said.sorted = ids();
      document.querySelector("tr[data-object-id='2'] a[data-show]").click();
      said.width = subiacoView().width;
      document.querySelector("tr[data-object-id='2'] [data-copy=place]").click(); said.place2 = subiacoCopied;
      document.querySelector("tr[data-object-id='2'] [data-copy=link]").click(); said.link = subiacoCopied;
      document.getElementById("reviewer").value = "Jo";
      document.querySelector("tr[data-object-id='2'] [data-review=rejected]").click();
      document.querySelector("tr[data-object-id='4'] [data-review=accepted]").click();
      said.struck = getComputedStyle(document.querySelector("tr[data-object-id='2'] td")).textDecorationLine;
      set("f-review", "rejected"); said.rejected = ids(); set("f-review", "");
      said.reviewed = document.getElementById("reviewed").textContent;
      said.file = subiacoReviewFile();
      document.getElementById("palette").value = "safe";
      document.getElementById("palette").dispatchEvent(new Event("input"));
      said.green = getComputedStyle(document.querySelector("tr[data-label=Added] .sign")).backgroundColor;
      subiacoPrintable().then(function () {
        said.decoded = document.querySelectorAll("div.proof img").length;
        said.offline = performance.getEntriesByType("resource").filter(function (r) {
          return !/^(data|blob):/.test(r.name);
        }).length;
        document.body.setAttribute("data-said", JSON.stringify(said));
      });
    }, 200);
  }
  begin();
}());
</script></body>"""


def browse(path, tmp_path, *more):
    """Open a file in headless Chromium and return the page as it ends up."""
    command = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000"]
    command += [f"--user-data-dir={tmp_path}", *more, path.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=True).stdout


needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on PATH")


def said_by(dom):
    """What a script wrote into the page."""
    return json.loads(unescape(re.search(r'data-said="([^"]*)"', dom).group(1)))


@needs_chromium
def test_in_a_browser_rows_filter_sort_follow_links_and_are_reviewed(
    html, result, tmp_path, change_directory
):
    page = tmp_path / "page.html"
    page.write_text(html.replace("</body>", CLICKS), encoding="utf-8")
    said = said_by(browse(page, tmp_path, "--dump-dom"))
    records = {r.object_id: r for r in result.records}
    changed = [r for r in records.values() if r.change.label in CHANGED_LABELS]
    added = [r for r in changed if r.change.label == "Added"]
    assert said["start"] == len(changed)
    assert said["histogram"] == 10
    assert said["added"] == len(added)
    assert said["sureAdded"] == sum(r.confidence >= 0.7 for r in added)
    assert said["buildings"] == sum(r.semantic.label == "building" for r in records.values())
    assert {int(i) for i in said["large"]} == {i for i, r in records.items() if abs(r.delta_v_m3) >= 100}
    assert {int(i) for i in said["wide"]} == {i for i, r in records.items() if r.area_m2 >= 100}
    assert said["search"] == ["5"]
    assert said["meant"] == ["6"]  # the word car means class mobile, new means Added
    assert 0 < len(said["place"]) < len(records)
    assert said["chosen"] == "4"
    height = [records[int(i)].delta_h_m for i in said["sorted"]]
    known = [value for value in height if np.isfinite(value)]
    assert known == sorted(known)
    assert len(known) >= 3
    assert 30 < said["width"] < 70  # of 114 m
    assert said["place2"] == f"{records[2].x:.3f}, {records[2].y:.3f}, {records[2].z:.3f} (EPSG:7850)"
    assert said["link"].endswith("page.html#object-2")
    assert said["struck"] == "line-through"
    assert said["rejected"] == ["2"]
    assert said["reviewed"] == f"2 of {len(changed)} changes reviewed: 1 accepted, 1 rejected; not saved yet"
    (tmp_path / "reviews.csv").write_text(said["file"], encoding="utf-8")
    uids = pd.read_csv(change_directory / "changes.csv").set_index("object_id")["object_uid"]
    reviews = read_review_file(tmp_path / "reviews.csv")
    assert reviews.loc[uids[2], ["review", "reviewer"]].tolist() == ["rejected", "Jo"]
    assert reviews.loc[uids[4], "review"] == "accepted"
    assert len(reviews) == 2
    assert said["green"] == "rgb(0, 158, 115)"
    assert said["decoded"] == len(changed)
    assert said["offline"] == 0


@needs_chromium
@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="no pdftotext on PATH")
def test_printed_on_a4_no_column_and_no_changed_row_is_lost(change_directory, result, tmp_path):
    printed = tmp_path / "report.pdf"
    browse(change_directory / "report.html", tmp_path, "--no-pdf-header-footer", f"--print-to-pdf={printed}")
    command = ["pdftotext", "-raw", str(printed), "-"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    changed = [r for r in result.records if r.change.label in CHANGED_LABELS]
    flat = " ".join(text.split())
    for _, heading, *_ in TABLE_COLUMNS:
        assert flat.count(heading) >= len(changed), heading
    for record in changed:
        assert f"rule {record.object_id}:" in flat
        assert " ".join(number(record.y, 1).split()) in flat
    size = subprocess.run(["pdfinfo", str(printed)], capture_output=True, text=True, check=True).stdout
    assert "A4" in size


def many_changes(result, count):
    """A result with so many changes, of all labels and classes, spread over the scene."""
    rng = np.random.default_rng(5)
    kinds = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)
    rows = []
    for k in range(count):
        template = result.records[k % 9]
        x, y = ORIGIN[:2] + rng.uniform([0, 0], [108, 68])
        rows.append(
            replace(
                template, object_id=k, change=kinds[k % 4], confidence=float(rng.uniform(0.3, 1)), x=x, y=y,
                footprint=box(x, y, x + 1.5, y + 1.0), reason=f"object {k}: height +{k % 7} m, limit 0.5 m",
            )
        )  # fmt: skip
    return replace(result, records=(*rows, replace(result.records[2], object_id=count)))


@pytest.fixture(scope="module", params=[100, 5000, 20_000])
def large(request, result, tmp_path_factory):
    """A change directory of many changes with small pictures, and the seconds its pages took."""
    target, rng = tmp_path_factory.mktemp("large") / "out", np.random.default_rng(1)
    drawn = evidence.Evidence(rng.bytes(1500), "M1 1L9 1L9 9Z", (3.0, 90.0), 40.0, 5, "looking north")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_page.evidence, "evidence_pictures", lambda _, rows: [drawn] * len(rows))
        changes = many_changes(result, request.param)
        write_change_directory(target, changes, SceneConfig(), ChangeInputs())
        begun = time.process_time()
        build_report(target)
        spent = time.process_time() - begun
    return request.param, target, spent


def test_a_page_of_any_number_of_changes_is_small_and_quickly_made(large):
    count, directory, spent = large
    html = (directory / "report.html").read_text(encoding="utf-8")
    document = unpacked(html)
    assert len(document["rows"]["object_id"]) == count + (count < 5000)
    assert document["left_out"] == (count >= 5000)
    chunks = sorted((directory / "report_files").glob("*.js")) if count > 500 else []
    assert len(chunks) == (-(-count // 100) if count > 500 else 0)
    assert len(inner_chunks(html)) == (count if count <= 500 else 0)
    assert len(html) < 2.0e6 + 100 * count + (8500 * count if count <= 500 else 0)
    assert all(chunk.stat().st_size < 1.2e6 for chunk in chunks)
    assert spent < 10.0 + 2e-3 * count


OPENED = """
<script>
(function () {
  function begin() {
    if (!document.documentElement.dataset.ready) { setTimeout(begin, 20); return; }
    var said = {};
    said.rows = document.querySelectorAll("#changes tbody tr").length;
    said.nodes = document.getElementsByTagName("*").length;
    said.pages = document.querySelector(".pages output").textContent;
    setTimeout(function () {
      said.pictures = document.querySelectorAll("#changes .proof img").length;
      document.body.setAttribute("data-said", JSON.stringify(said));
    }, 600);
  }
  begin();
}());
</script></body>"""


@needs_chromium
def test_a_browser_opens_any_number_of_changes_with_a_page_of_rows_and_the_pictures_in_view(large, tmp_path):
    count, directory, _ = large
    page = directory / "opened.html"
    page.write_text((directory / "report.html").read_text().replace("</body>", OPENED), encoding="utf-8")
    begun = time.monotonic()
    said = said_by(browse(page, tmp_path, "--window-size=1200,900", "--dump-dom"))
    spent = time.monotonic() - begun
    assert said["rows"] == 50
    assert said["pages"] == f"page 1 of {-(-count // 50)}"
    assert said["nodes"] < 6000
    assert said["pictures"] < 50  # those in view, and near it
    assert spent < 30.0  # with the start of the browser, on a machine that does other work


LONG = "A survey was moved by 1.80 m, which is 18 times the standard deviation of 9.8 cm, and so on. " * 3


@needs_chromium
@pytest.mark.parametrize("alarms", [0, 1, 3, 5])
def test_the_summary_prints_on_two_sheets_and_nothing_is_cut_off(change_directory, tmp_path, alarms):
    if alarms:
        shutil.copytree(change_directory, tmp_path / "copy")
        change_directory = tmp_path / "copy"
        run = json.loads((change_directory / "run.json").read_text())
        run["findings"] = [
            Finding(f"code_{k}", "serious", LONG, "Do that.").document() for k in range(alarms)
        ]
        (change_directory / "run.json").write_text(json.dumps(run))
        build_report(change_directory)
    page = tmp_path / "summary.html"
    fits = """<script>document.body.setAttribute("data-fits", Array.prototype.map.call(
      document.querySelectorAll(".page"), function (p) {
      var foot = p.querySelector("footer").getBoundingClientRect().top;
      return Array.prototype.every.call(p.children, function (c) { return c.tagName === "FOOTER" ||
      c.getBoundingClientRect().bottom <= foot; }); }).join());</script></body>"""
    page.write_text((change_directory / "summary.html").read_text().replace("</body>", fits))
    assert 'data-fits="true,true"' in browse(page, tmp_path, "--dump-dom")
    browse(page, tmp_path, f"--print-to-pdf={tmp_path / 'out.pdf'}")
    assert len(re.findall(rb"/Type */Page\b", (tmp_path / "out.pdf").read_bytes())) == 2

"""The report is complete, stands alone, and opens in a browser without a network."""

import json
import re
import shutil
import subprocess
import time
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from result_scene import SceneConfig

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_change.report import page as report_page
from subiaco_change.report import pictures
from subiaco_change.report.facts import CHANGED_LABELS, number, summary
from subiaco_change.report.page import build_report, fullest_blocks
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_geo.findings import Finding

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


@pytest.fixture(scope="module")
def html(change_directory):
    return (change_directory / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(html):
    return Page(html)


def test_every_row_of_the_table_is_there_and_changed_ones_come_first(page, result):
    assert set(page.rows) == {r.object_id for r in result.records}
    changed = [row["data-changed"] for row in page.rows.values()]
    assert changed == sorted(changed, reverse=True)
    for record in result.records:
        row = page.rows[record.object_id]
        assert row["data-label"] == record.change.label
        assert (row["data-changed"] == "1") == (record.change.label in CHANGED_LABELS)


def test_every_block_has_its_five_pictures_and_all_have_a_text_instead(html, page):
    blocks = re.findall(r'<details class="block" id="block-\w+" data-block="(\w+)"', html)
    assert blocks == ["A1", "A2"]
    for block in blocks:
        texts = [i["alt"] for i in page.images if i["alt"].startswith(f"Block {block},")]
        kinds = [text.split(", ", 1)[1].split(":")[0] for text in texts]
        assert sorted(kinds) == ["Change", "Height", "Instances", "Projection", "Semantics"]


def test_every_changed_row_carries_its_evidence_and_the_others_none(page, result):
    changed = {r.object_id for r in result.records if r.change.label in CHANGED_LABELS}
    proofs = [i for i in page.images if i["alt"].startswith("Object ")]
    assert {int(i["alt"].split()[1]) for i in proofs} == changed
    assert len(proofs) == len(changed)
    assert all(i["src"].startswith("data:image/webp;base64,") and i["loading"] == "lazy" for i in proofs)


def test_every_changed_object_can_be_clicked_on_the_map_and_leads_back(page, result):
    changed = {r.object_id for r in result.records if r.change.label in CHANGED_LABELS}
    assert {f"shape-{i}" for i in changed} <= page.ids
    assert {f"#object-{i}" for i in changed} | {f"#shape-{i}" for i in changed} <= set(page.links)


def test_rows_stand_from_sure_to_doubtful_with_the_reason_in_words(page, html, result):
    kept = [row for row in page.rows.values() if row["data-changed"] == "1"]
    sure = [float(row["data-conf"]) for row in kept]
    assert sure == sorted(sure, reverse=True)
    for record in result.records:
        assert record.reason.replace("&", "&amp;").replace(">", "&gt;") in html
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


def test_nine_thousand_rows_make_a_page_that_a_browser_opens(result, tmp_path, monkeypatch):
    rng = np.random.default_rng(5)
    kinds = (Change.ADDED, Change.REMOVED, Change.UNCHANGED)
    rows = [
        replace(
            result.records[k % 6], object_id=k, change=kinds[k % 3], confidence=float(rng.uniform(0.5, 1))
        )
        for k in range(9000)
    ]
    target = tmp_path / "out"
    monkeypatch.setattr(report_page, "_MOST_PICTURES", 12)
    begun = time.process_time()
    write_change_directory(target, replace(result, records=tuple(rows)), SceneConfig(), ChangeInputs())
    spent = time.process_time() - begun
    text = (target / "report.html").read_text(encoding="utf-8")
    page, words = Page(text), re.sub(r"<[^>]+>", "", text)
    assert len(page.rows) == 3000
    assert all(row["data-changed"] == "1" for row in page.rows.values())
    assert "3000 of 9000 rows" in words
    assert len([i for i in page.images if i["alt"].startswith("Object ")]) == 12
    assert "5988 changed rows have no picture" in words
    assert {link[1:] for link in page.links} <= page.ids
    assert len(text) < 12e6
    assert spent < 60.0


def test_the_page_refers_to_nothing_outside_itself(html, page):
    without_pictures = re.sub(r"data:image/(png|webp);base64,[A-Za-z0-9+/=]+", "", html)
    assert not re.search(r"https?://|(?:src|<image href)=\"(?!\")[^\"]|@import|url\(", without_pictures)
    assert all(re.match("data:image/(png|webp);base64,", image["src"]) for image in page.images)
    assert all(link.startswith("#") for link in page.links)
    assert {link[1:] for link in page.links} <= page.ids


def test_tags_close_and_texts_from_outside_are_escaped(html, page):
    assert page.open == []
    assert "<test & escape>" not in html
    assert "&lt;test &amp; escape&gt;" in html


def test_it_says_in_words_what_the_registration_and_the_detection_limit_mean(page):
    text = " ".join(" ".join(page.text).split())
    assert "2.1 cm apart" in text
    assert "93 % of the surface pairs" in text
    assert "cannot be told from noise" in text
    assert "1 object stands where the other epoch could not look" in text
    assert "EPSG:7850" in text


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


def test_the_summary_counts_every_row_once():
    table = pd.DataFrame({"class": ["building", "ground"], "label": ["Added", "Increased"]})
    rows = summary(table)
    assert rows[-1]["class"] == "all"
    assert rows[-1]["total"] == 2
    assert sum(row["total"] for row in rows[:-1]) == 2


CLICKS = """
<script>
window.addEventListener("load", function () {
  var said = {}, rows = function () { return document.querySelectorAll("#changes tbody tr:not([hidden])"); };
  function set(id, value) {
    var box = document.getElementById(id);
    box.value = value; box.dispatchEvent(new Event("input"));
  }
  said.start = rows().length;
  said.decoded = Array.prototype.filter.call(document.querySelectorAll("div.proof img"), function (i) {
    return i.naturalWidth > 0;
  }).length;
  set("f-label", "Added"); said.added = rows().length;
  said.marks = document.querySelectorAll("#city a[data-of]:not(.off)").length;
  set("f-conf", "0.7"); said.sureAdded = rows().length; set("f-conf", "0");
  set("f-label", ""); set("f-class", "building"); said.buildings = rows().length; set("f-class", "");
  set("f-text", "rule 5"); said.search = rows().length; set("f-text", "");
  set("f-label", "Removed");
  location.hash = "#object-4";
  setTimeout(function () {
    said.clicked = !document.getElementById("object-4").hidden;
    document.querySelectorAll("#changes th button")[4].click();
    said.sorted = Array.prototype.map.call(rows(), function (r) { return r.dataset.objectId; });
    location.hash = "#shape-2";
    setTimeout(function () {
      said.width = document.getElementById("city").viewBox.baseVal.width;
      said.offline = performance.getEntriesByType("resource").filter(function (r) {
        return r.name.indexOf("data:") !== 0;
      }).length;
      document.body.setAttribute("data-said", JSON.stringify(said));
    }, 100);
  }, 100);
});
</script></body>"""


def browse(path, tmp_path, *more):
    """Open a file in headless Chromium and return the page as it ends up."""
    command = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000"]
    command += [f"--user-data-dir={tmp_path}", *more, path.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=True).stdout


needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on PATH")


@needs_chromium
def test_in_a_browser_rows_filter_sort_and_follow_clicks_without_a_network(html, result, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(html.replace("</body>", CLICKS), encoding="utf-8")
    dom = browse(page, tmp_path, "--dump-dom")
    said = json.loads(re.search(r'data-said="([^"]*)"', dom).group(1).replace("&quot;", '"'))
    records = result.records
    added = [r for r in records if r.change.label == "Added"]
    assert said["start"] == said["decoded"] == sum(r.change.label in CHANGED_LABELS for r in records)
    assert said["added"] == said["marks"] == len(added)
    assert said["sureAdded"] == sum(r.confidence >= 0.7 for r in added)
    assert said["buildings"] == sum(r.semantic.label == "building" for r in records)
    assert said["search"] == 1
    assert said["clicked"]
    assert 30 < said["width"] < 70  # of 114 m
    assert said["offline"] == 0
    height = {r.object_id: r.delta_h_m for r in records}
    known = [height[int(i)] for i in said["sorted"] if np.isfinite(height[int(i)])]
    assert known == sorted(known)
    assert len(known) >= 3


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

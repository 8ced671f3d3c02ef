"""The report is complete, stands alone, and opens in a browser without a network."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest

from subiaco_change.report.page import CHANGED_LABELS, build_report, number, summary
from subiaco_geo.errors import InputError

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
    blocks = re.findall(r'<details class="block" data-block="(\w+)"', html)
    assert blocks == ["A1", "A2"]
    for block in blocks:
        texts = [i["alt"] for i in page.images if i["alt"].startswith(f"Block {block},")]
        kinds = [text.split(", ", 1)[1].split(":")[0] for text in texts]
        assert sorted(kinds) == ["Change", "Height", "Instances", "Projection", "Semantics"]
    assert len(page.images) == 1 + 5 * len(blocks)


def test_the_page_refers_to_nothing_outside_itself(html, page):
    without_pictures = re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", html)
    assert not re.search(r"https?://|src=\"(?!\")[^\"]|@import|url\(", without_pictures)
    assert all(image["src"].startswith("data:image/png;base64,") for image in page.images)
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


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on PATH")
def test_the_script_filters_and_counts_in_a_browser(change_directory, tmp_path):
    command = ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000"]
    command += [f"--user-data-dir={tmp_path}", "--dump-dom", (change_directory / "report.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    assert "6 of 10 rows" in done.stdout
    assert len(re.findall(r'<tr id="object-\d+"[^>]* hidden=""', done.stdout)) == 4

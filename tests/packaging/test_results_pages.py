"""Pages of results equal what the generators make of the data, and each table says what measured it."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
TABLES = sorted((RESULTS / "data").glob("*/*.json"))
#: Pages that a benchmark writes whole, from one data file.
WHOLE = {
    "benchmarks": ("tabulated", ROOT / "benchmarks.json"),
    "learned": ("bench_learned", RESULTS / "data/learned.json"),
    "damaged-files": ("fuzz_readers", RESULTS / "data/damaged-files.json"),
}


@pytest.fixture(scope="module")
def results() -> Iterator[Any]:
    """Return the generator of the pages, by a name that no module of the benchmarks has."""
    sys.path.insert(0, str(ROOT / "scripts"))
    spec = importlib.util.spec_from_file_location("results_generator", ROOT / "scripts" / "results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(ROOT / "scripts"))
        sys.modules.pop(spec.name, None)


def test_every_page_equals_what_the_generator_makes_of_the_data(results: Any) -> None:
    different = [
        str(page.relative_to(ROOT))
        for page in results.pages()
        if results.render(text := page.read_text(encoding="utf-8")) != text
    ]
    assert different == [], "run: python scripts/results.py"


@pytest.mark.parametrize("name", WHOLE)
def test_a_page_that_a_benchmark_writes_equals_its_data(name: str) -> None:
    program, data = WHOLE[name]
    script = f"import json, sys, {program}; sys.stdout.write({program}.page(json.load(open(sys.argv[1]))))"
    folder = ROOT / "tests" / "benchmarks"
    made = subprocess.run(
        [sys.executable, "-c", script, str(data)], cwd=folder, capture_output=True, text=True, check=True
    )
    assert made.stdout == (RESULTS / f"{name}.md").read_text(encoding="utf-8")


def test_no_table_of_a_page_of_results_is_typed_by_hand() -> None:
    for page in sorted(RESULTS.glob("*.md")):
        if page.stem in WHOLE or page.name == "index.md":
            continue
        text = re.sub(r"<!-- table: .*?<!-- end -->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert not re.search(r"^ *\|", text, flags=re.MULTILINE), page


def test_every_data_file_is_shown_on_a_page(results: Any) -> None:
    shown = {
        n
        for page in results.pages()
        for n in re.findall(r"<!-- (?:table|sentences): ([\w/-]+)", page.read_text())
    }
    names = {path.relative_to(RESULTS / "data").with_suffix("").as_posix() for path in TABLES}
    assert names == shown
    assert len(names) > 30


@pytest.mark.parametrize("path", TABLES, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_a_table_says_what_measured_it_when_and_where(path: Path) -> None:
    table = json.loads(path.read_text(encoding="utf-8"))
    assert table["source"] in {"measured", "recorded"}
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", table["date"])
    assert re.fullmatch(r"[0-9a-f]{7,12}(-dirty)?", table["revision"])
    assert table["command"]
    assert table["machine"]
    assert all(len(row) == len(table["columns"]) for row in table["rows"])


def test_a_figure_of_the_front_page_is_a_cell_of_the_table_that_it_names(results: Any) -> None:
    front = results.load("front/figures")
    shown = {row[0]: dict(zip(front["columns"], row, strict=True)) for row in front["rows"]}
    assert set(shown) - set(front["cells"]) == {"points, millions", "minutes"}, (
        "of 60.7 M + 70.0 M and 1,443 s"
    )
    for figure, (name, first, column) in front["cells"].items():
        if name == "learned/surveys":
            learned = json.loads((RESULTS / "data/learned.json").read_text(encoding="utf-8"))
            (row,) = [row for row in learned["surveys"] if row["method"] == first]
            assert (row[column], learned["day"]) == (shown[figure]["value"], shown[figure]["date"]), figure
            assert shown[figure]["revision"] == learned["revision"], figure
            continue
        table = results.load(name)
        (row,) = [row for row in table["rows"] if row[0] == first]
        found = dict(zip(table["columns"], row, strict=True))[column]
        expected = (found, table["date"], table["revision"])
        assert expected == tuple(shown[figure][key] for key in ("value", "date", "revision")), figure


def test_a_command_is_recorded_with_the_table_that_it_prints(results: Any, tmp_path: Path) -> None:
    printed = "words\n| survey | mIoU |\n|---|---|\n| a | 81.50 |\n| b | 79.5 |\n"
    path = results.record(
        "page/scores", [sys.executable, "-c", f"print({printed!r})"], "1, 2", None, tmp_path
    )
    table = results.load("page/scores", tmp_path)
    assert path == tmp_path / "page/scores.json"
    assert table["rows"] == [["a", "81.50"], ["b", 79.5]]
    assert (table["source"], table["seeds"]) == ("measured", "1, 2")
    page = "<!-- table: page/scores -->\n\nold\n\n<!-- end -->"
    made = results.render(page, tmp_path)
    assert "| a | 81.50 |\n| b | 79.5 |" in made
    assert results.render(made, tmp_path) == made


def test_rows_in_json_and_what_is_no_table(results: Any) -> None:
    assert results.read_output('[{"a": 1}, {"a": 2, "b": "x"}]') == (["a", "b"], [[1, None], [2, "x"]])
    with pytest.raises(SystemExit, match="neither a Markdown table"):
        results.read_output("no table")


def test_a_table_needs_no_empty_line_below_its_comment(results: Any, tmp_path: Path) -> None:
    (tmp_path / "page").mkdir()
    table = {"title": "t", "columns": ["a"], "rows": [[1]], "command": "c", "seeds": "1", "date": "d"}
    table |= {"revision": "r", "machine": "m", "source": "recorded"}
    (tmp_path / "page" / "table.json").write_text(json.dumps(table), encoding="utf-8")
    shown = results.render("<!-- table: page/table -->\n<!-- end -->\n", tmp_path)
    assert "| a |" in shown
    assert shown == results.render("<!-- table: page/table -->\n\n<!-- end -->\n", tmp_path)
    assert shown == results.render(shown, tmp_path)


def test_a_sentence_takes_its_figures_from_the_table(results: Any, tmp_path: Path) -> None:
    table = {
        "title": "t",
        "columns": ["figure", "value"],
        "sentences": ["{a} of {b} km."],
        "rows": [["a", 1.5], ["b", 2]],
    }
    results.store("p/t", table, tmp_path)
    page = "<!-- sentences: p/t -->\n\n<!-- end -->"
    assert results.render(page, tmp_path) == "<!-- sentences: p/t -->\n\n* 1.5 of 2 km.\n\n<!-- end -->"
    results.store("p/t", {**table, "sentences": ["{c} km"]}, tmp_path)
    with pytest.raises(SystemExit, match="no row is named c"):
        results.render(page, tmp_path)

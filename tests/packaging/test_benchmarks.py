"""`make bench`: what it runs is there, and its page says what its JSON says."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("bench", "tabulated", "results"):
        monkeypatch.delitem(sys.modules, name, raising=False)


def test_every_benchmark_names_a_program_that_leaves_json_and_only_surveys_that_are_made() -> None:
    import bench

    for benchmark in bench.BENCHMARKS:
        assert '"--json"' in (FOLDER / benchmark.program).read_text()
        folders = {survey.name: "x" for survey in benchmark.surveys}
        for line in benchmark.lines:
            assert "{" not in line.format(**folders)


def test_the_page_shows_rows_absent_peers_and_remarks() -> None:
    from tabulated import page

    found = {
        "machine": {"cpu": "a", "packages": {"numpy": "2.0"}},
        "seed": 101,
        "surveys": {"maps": "subiaco simulate out/bench/maps"},
        "benchmarks": {
            "one": {
                "title": "One",
                "commands": ["python one.py"],
                "rows": [
                    {"method": "ours", "CPU s": 1.25},
                    {"method": "theirs", "of ours": 2.0, "points": 12345},
                ],
                "absent": {"third": "cannot be imported"},
                "remarks": ["one thread"],
            }
        },
    }
    told = page(found)
    assert "| ours | 1.25 |  |  |" in told
    assert "| theirs |  | 2 | 12,345 |" in told
    assert "* third absent: cannot be imported." in told
    assert "* one thread." in told


def test_results_are_read_back_as_they_were_kept(tmp_path: Path) -> None:
    import json

    from results import keep, rounded

    keep(tmp_path / "r.json", [{"a": rounded(1234.5)}], {"b": "c"}, ["d"])
    assert json.loads((tmp_path / "r.json").read_text()) == {
        "rows": [{"a": 1230.0}], "absent": {"b": "c"}, "remarks": ["d"],
    }  # fmt: skip
    keep(None, [])  # a run by hand leaves none

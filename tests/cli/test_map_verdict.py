"""The verdict on a map, on the terminal and as the exit code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
import yaml

from subiaco_bringup.cli.map_verdict import end_with_verdict

SENTENCE = "Contradicted by its own fixes: nothing could be measured."


def written(folder: Path, contradicts: bool) -> Path:
    wrong = ["am: 42 of 44 fixes are farther off the map than they state"]
    verdict = {"grade": "contradicted", "sentence": SENTENCE, "wrong": wrong}
    (folder / "quality.json").write_text(json.dumps({"verdict": verdict}))
    (folder / "manifest.yaml").write_text(yaml.safe_dump({"gnss_contradicts": contradicts}))
    return folder


def test_a_map_that_its_fixes_contradict_ends_with_three_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        end_with_verdict(written(tmp_path, contradicts=True), quiet=False)
    assert ended.value.exit_code == 3
    first, second = capsys.readouterr().err.splitlines()
    assert first == SENTENCE
    assert second.startswith(f"{tmp_path}: the map's own fixes contradict it (am: 42 of 44 fixes")


def test_a_map_that_they_bear_out_only_says_its_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    end_with_verdict(written(tmp_path, contradicts=False), quiet=False)
    assert capsys.readouterr().err == SENTENCE + "\n"


def test_without_a_quality_page_nothing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    end_with_verdict(tmp_path, quiet=False)
    assert capsys.readouterr().err == ""

"""Commands that the documentation shows: verbs and options exist, and the tutorial of two clouds runs."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path, languages: str = r"(?:bash|text)?") -> list[str]:
    """Return blocks of code in a page; a block may be indented below a list."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^ *```{languages}\n(.*?)^ *```$", text, flags=re.DOTALL | re.MULTILINE)


def commands(block: str) -> list[list[str]]:
    """Return the words of every line that begins with ``subiaco``; continued lines are joined."""
    lines = re.sub(r"\\\n\s*", " ", block).splitlines()
    found = [re.sub(r"^(?:[A-Z_]+=\S+\s+)+", "", line.strip()) for line in lines]
    words = [
        shlex.split(line.split(" > ")[0], comments=True) for line in found if line.startswith("subiaco ")
    ]
    return [one[1:] for one in words]


SHOWN = [(page, words) for page in PAGES for block in blocks(page) for words in commands(block)]


@pytest.fixture(scope="module")
def command() -> Any:
    from typer.main import get_command

    from subiaco_bringup.cli.main import app

    return get_command(app)


def fault(command: Any, words: list[str]) -> str | None:
    """Return what is wrong with a command that is shown, None where verb and options exist."""
    rest = list(words)
    while hasattr(command, "commands"):
        verb = rest.pop(0) if rest else ""
        if verb == "--version":
            return None
        if verb not in command.commands:
            return f"no verb {verb!r}"
        command = command.commands[verb]
    known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"-h", "--help"}
    unknown = [word for word in rest if re.match(r"--?[a-zA-Z]", word) and word.split("=")[0] not in known]
    return f"no option {unknown}" if unknown else None


def test_the_documentation_shows_commands() -> None:
    assert len(SHOWN) > 60
    assert len({page for page, _ in SHOWN}) > 12


def test_every_verb_and_every_option_that_a_page_shows_exists(command: Any) -> None:
    found = {f"{page.name}: {' '.join(words)}": fault(command, words) for page, words in SHOWN}
    assert {line: wrong for line, wrong in found.items() if wrong} == {}


def test_a_wrong_verb_or_option_would_be_noticed(command: Any) -> None:
    assert fault(command, ["compare", "a", "b"]) == "no verb 'compare'"
    assert fault(command, ["change", "a", "b", "-o", "c", "--worker", "2"]) == "no option ['--worker']"
    assert fault(command, ["graph", "live", "-o", "x", "--no-record"]) is None


def test_every_setting_that_a_page_shows_exists(command: Any) -> None:
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        from reference_pages.settings import models, settings
    finally:
        sys.path.remove(str(ROOT / "scripts"))
    known = {s.name for _, model, _ in models().values() for s in settings(model)}
    known |= {name.removeprefix("injection.") for name in known}
    shown = {
        (page.name, words[i + 1].split("=")[0])
        for page, words in SHOWN
        for i, word in enumerate(words[:-1])
        if word == "--set"
    }
    assert len(shown) > 8
    assert {(page, name) for page, name in shown if name not in known} == set()


def test_the_tutorial_of_two_clouds_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two clouds of a street with three houses (seeds 1 and 2) stand for what a reader downloads."""
    import numpy as np

    from subiaco_bringup.cli.main import run
    from subiaco_geo.cloud_io import write_cloud
    from subiaco_geo.clouds import from_world

    monkeypatch.chdir(tmp_path)
    for seed, name in ((1, "before.laz"), (2, "after.laz")):
        world = _street(np.random.default_rng(seed)) + np.array([391_200.0, 6_464_300.0, 12.0])
        write_cloud(tmp_path / name, from_world(world, crs="EPSG:7850"))
    steps = [w for block in blocks(ROOT / "docs/tutorials/two-clouds.md", "bash") for w in commands(block)]
    assert len(steps) == 4
    for words in steps:
        assert run([*words, "-q"]) == 0, (words, capsys.readouterr().err)
    for written in ("pair/summary.html", "pair/report.html", "strict/changes.csv", "geojson", "ply"):
        assert (tmp_path / "out" / written).exists()


def _street(rng: Any) -> Any:
    """Return points (N, 3) of a floor of 40 m x 30 m with three boxes [m]."""
    import numpy as np

    parts = [rng.uniform([0, 0, 0], [40, 30, 0.02], (12_000, 3))]
    for west, south, width, depth, height in [(4, 4, 8, 6, 5), (22, 5, 5, 9, 3), (12, 20, 12, 5, 4)]:
        box = rng.uniform([west, south, 0], [west + width, south + depth, height], (5000, 3))
        side = rng.integers(0, 5, len(box))
        for number, (axis, value) in enumerate(
            [(0, west), (0, west + width), (1, south), (1, south + depth), (2, height)]
        ):
            box[side == number, axis] = value
        parts.append(box)
    return np.concatenate(parts) + rng.normal(0.0, 0.01, (12_000 + 3 * 5000, 3))

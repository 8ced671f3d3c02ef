"""Commands that the documentation shows run on a tiny survey, or the list says why they cannot."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import shown_drive as drive
from shown_commands import NOT_RUN, PAGES, ROOT, RUN, SHOWN, SMALLER, Shown
from shown_world import World, outputs

OURS = [line for line in SHOWN if line.words[:1] == ["subiaco"]]
#: A command inside a sentence, with its options.
INLINE = {
    (page, found)
    for page in PAGES
    for found in re.findall(r"`subiaco ([a-z][^`]+)`", page.read_text(encoding="utf-8"))
}
SHOWN_WORDS = [(line.page, line.words[1:]) for line in OURS]
SHOWN_WORDS += [(page, shlex.split(re.sub(r" \.\.\.|\[|\]", "", text))) for page, text in sorted(INLINE)]


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
    assert len(OURS) > 60
    assert len({line.page for line in OURS}) > 12


def test_every_verb_and_every_option_that_a_page_shows_exists(command: Any) -> None:
    found = {f"{page.name}: {' '.join(words)}": fault(command, words) for page, words in SHOWN_WORDS}
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
        for page, words in SHOWN_WORDS
        for i, word in enumerate(words[:-1])
        if word == "--set"
    }
    assert len(shown) > 8
    assert {(page, name) for page, name in shown if name not in known} == set()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Return the folder in which all commands run, in the order of the pages."""
    root = tmp_path_factory.mktemp("world")
    before = Path.cwd()
    os.chdir(root)
    try:
        yield World(root)
    finally:
        os.chdir(before)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("line", RUN, ids=lambda line: line.name)
def test_a_command_that_a_page_shows_runs(
    line: Shown, world: World, capfd: pytest.CaptureFixture[str]
) -> None:
    words = line.words
    world.provide(words)
    if words[0] == "subiaco":
        from subiaco_bringup.cli.main import run

        code = run([*words[1:], *SMALLER.get(words[1], [])])
    else:
        assert words[0] == "python", f"{line.name}: add it to NOT_RUN with the reason, or run it"
        code = run_script(words[1:])
    captured = capfd.readouterr()
    assert code == 0, captured.err
    if line.redirected:
        (world.root / line.redirected).write_text(captured.out, encoding="utf-8")
    for name in outputs(words):
        assert (world.root / name).exists(), f"{name} was not written"
    world.keep(words)


@pytest.mark.slow
def test_the_commands_of_the_front_page_find_the_box_that_the_later_survey_has_more(world: World) -> None:
    import pandas as pd

    table = pd.read_csv(world.change() / "changes.csv")
    claims = table[table["label"].isin(["Added", "Removed", "Increased", "Decreased"])]
    assert list(claims["label"]) == ["Added"]
    west, south, _, east, north, _ = (drive.NEW[0].reshape(2, 3) + drive.CORNER).ravel()
    assert claims["x"].between(west, east).all()
    assert claims["y"].between(south, north).all()
    stated = table["reason"].str.fullmatch(r"[A-Z0-9].*\d.*limit.*\d.*[:,] .*[a-z]+\.")
    assert table["reason"][~stated].tolist() == []


def run_script(words: list[str]) -> int:
    """Run a script in this process, as ``python SCRIPT ARGUMENTS`` does, and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", words)
        patch.syspath_prepend(str((ROOT / words[0]).parent))
        try:
            runpy.run_path(str(ROOT / words[0]), run_name="__main__")
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def test_a_reason_for_not_running_is_needed_and_names_tests_that_exist() -> None:
    for pattern, why in NOT_RUN.items():
        assert any(re.search(pattern, line.line) for line in SHOWN), f"no page shows {pattern}"
        for test in re.findall(r"tests/[\w/]+\.py", why):
            assert (ROOT / test).is_file(), test
    assert len(NOT_RUN) < 13
    assert len(RUN) > 45


def test_every_script_and_every_option_of_a_script_that_a_page_shows_exists() -> None:
    scripts = [line.words for line in SHOWN if line.words[:1] == ["python"] and line.words[1].endswith(".py")]
    assert len(scripts) > 10
    for words in scripts:
        source = (ROOT / words[1]).read_text(encoding="utf-8")
        own = words[: words.index("--")] if "--" in words else words
        assert [word for word in own if re.match(r"--[a-z]", word) and f'"{word}"' not in source] == [], words


def test_every_make_target_in_a_block_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    shown = {line.words[1] for line in SHOWN if line.words[:1] == ["make"]}
    assert len(shown) > 4
    assert shown <= targets


def test_no_command_hides_in_an_indented_block() -> None:
    for page in PAGES:
        text = re.sub(
            r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
        )
        hidden = re.findall(r"^ {4}(?:subiaco|python|make) .*", text, flags=re.MULTILINE)
        assert hidden == [] or page.name == "benchmarks.md", page

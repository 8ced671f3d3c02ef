"""The documentation builds as a site without a warning, and the commands that it shows exist."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site strictly: a broken link, or an anchor that is not there, is an error."""
    target = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(target)]
    told = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=told, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    return target


def test_every_page_is_built(site: Path) -> None:
    for page in (ROOT / "docs").rglob("*.md"):
        assert (site / page.relative_to(ROOT / "docs")).with_suffix(".html").is_file()


def test_formulas_need_no_script(site: Path) -> None:
    page = (site / "explanation/method.html").read_text(encoding="utf-8")
    assert page.count("<math") > 40
    assert "arithmatex" not in page


def test_no_page_loads_anything_from_another_server(site: Path) -> None:
    loaded = re.compile(r'<(?:script|img|link)[^>]*(?:src|href)="?(https?:)?//[^" >]+')
    for page in site.rglob("*.html"):
        assert not loaded.search(page.read_text(encoding="utf-8")), page


def test_links_out_of_the_documentation_became_paths(site: Path) -> None:
    page = (site / "how-to/ros-tools.html").read_text(encoding="utf-8")
    assert "<code>config/dds/README.md</code>" in page or "(<code>config/dds" in page
    targets = {t.split("#")[0] for t in re.findall(r'href="?(\.\.?/[^" >]+)', page)}
    assert len(targets) > 10
    assert all((site / "how-to" / target).resolve().is_relative_to(site) for target in targets)


def test_three_readers_find_the_answers_to_twelve_questions_each() -> None:
    text = (ROOT / "docs/questions.md").read_text(encoding="utf-8")
    questions = re.findall(r"^\d+\. \[([^\]]+)\]\(([^)]+)\)$", text, flags=re.MULTILINE)
    assert [len(re.findall(r"^\d+\.", part, flags=re.MULTILINE)) for part in text.split("\n## ")[1:]] == [
        12
    ] * 3
    assert len({question for question, _ in questions}) == len(questions) == 36
    assert all(question.endswith("?") for question, _ in questions)


def test_every_command_that_the_documentation_shows_is_a_verb() -> None:
    from typer.main import get_command

    from subiaco_bringup.cli.main import app

    verbs = set(get_command(app).commands)  # type: ignore[attr-defined]
    shown: dict[str, Path] = {}
    for page in PAGES:
        for block in re.findall(r"```\w*\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL):
            shown |= dict.fromkeys(re.findall(r"^\s*subiaco ([a-z][a-z-]*)", block, flags=re.MULTILINE), page)
        inline = re.findall(r"`subiaco ([a-z][a-z-]*)[` ]", page.read_text(encoding="utf-8"))
        shown |= dict.fromkeys(inline, page)
    assert len(shown) > 10
    assert not {verb: str(page) for verb, page in shown.items() if verb not in verbs}


def test_every_make_target_that_the_documentation_shows_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page in PAGES:
        for target in re.findall(r"`make ([a-z-]+)`", page.read_text(encoding="utf-8")):
            assert target in targets, f"{page}: make {target}"


def test_every_link_of_the_front_page_leads_to_a_file() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    links = [t for t in re.findall(r"\]\(([^)#]+)[^)]*\)", text) if not t.startswith("http")]
    assert len(links) > 20
    assert not [target for target in links if not (ROOT / target).exists()]


def test_every_link_of_the_documentation_leads_to_a_file_of_the_repository() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page}: {target}"


def test_links_to_sources_of_generated_pages_lead_to_these_pages_on_the_site(site: Path) -> None:
    text = (site / "questions.html").read_text(encoding="utf-8")
    for name in ("files", "messages", "settings"):
        assert re.search(rf'href="?reference/{name}\.html', text), name


def test_every_figure_of_the_front_page_stands_on_the_page_that_it_links() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\* \*\*.+?(?=^\* |^$)", text, flags=re.MULTILINE | re.DOTALL)
    assert len(lines) == 6
    for line in lines:
        (page,) = set(re.findall(r"\]\((docs/[^)#]+)", line))
        shown = (ROOT / page).read_text(encoding="utf-8")
        missing = [figure for figure in re.findall(r"\b\d+\.\d+\b", line) if figure not in shown]
        assert not missing, f"{line}: {missing} not on {page}"


def test_every_page_of_results_is_listed() -> None:
    listed = (ROOT / "docs/results/index.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs/results").glob("*.md"):
        assert page.name == "index.md" or f"({page.name})" in listed, page

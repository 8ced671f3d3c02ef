"""What the documentation site does beside Markdown.

Formulas become MathML, so that a page needs no script. A link to a file of the repository outside of ``docs``
becomes the path of that file, because the site does not hold it. Pages of the reference are generated from
the code (``scripts/reference_pages``). A link to the source of a generated page,
which the repository has, leads to the page on the site.
"""

from __future__ import annotations

import html
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from reference_pages import pages

from subiaco_geo import __version__

ROOT = Path(__file__).resolve().parents[1]
_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)
_LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<target>\.\./[^)#]*)(?P<anchor>#[^)]*)?\)")
#: What a link leads to in the repository, and the generated page that it leads to on the site.
_GENERATED = {
    "config": "reference/settings.md",
    "scripts/reference_pages/output_files.yaml": "reference/files.md",
    "src/subiaco_change/subiaco_change/config.py": "reference/settings-change.md",
    "src/subiaco_change/subiaco_change/method_rules": "reference/rules.md",
    "src/subiaco_evaluation/subiaco_evaluation/baselines/config.py": "reference/settings-baselines.md",
    "src/subiaco_evaluation/subiaco_evaluation/learned/config.py": "reference/settings-training.md",
    "src/subiaco_mapping/subiaco_mapping/config.py": "reference/settings-mapping.md",
    "src/subiaco_msgs": "reference/messages.md",
    "src/subiaco_sim/subiaco_sim/config.py": "reference/settings-simulation.md",
}


def on_config(config: Any) -> Any:
    """Name the version in the title of the site; a hook of MkDocs."""
    config["site_name"] = f"Subiaco {__version__}"
    return config


def on_files(files: Files, config: Any, **_: object) -> Files:
    """Add the generated pages of the reference; a hook of MkDocs."""
    for name, text in pages().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Return a page without links that leave ``docs``; a hook of MkDocs."""
    folder = PurePosixPath("docs", page.file.src_uri).parent
    return _LINK.sub(lambda found: _inside(found, folder), markdown)


def on_page_content(content: str, **_: object) -> str:
    """Return a page whose formulas are MathML; a hook of MkDocs."""
    return _FORMULA.sub(_mathml, content)


def _inside(link: re.Match[str], folder: PurePosixPath) -> str:
    path = (ROOT / folder / link["target"]).resolve()
    if path.is_relative_to(ROOT / "docs"):
        return link[0]
    if not path.exists():
        raise FileNotFoundError(f"{folder}: the link {link[0]} leads nowhere")
    name = path.relative_to(ROOT).as_posix()
    if name in _GENERATED:
        page = os.path.relpath(PurePosixPath("docs", _GENERATED[name]), folder)
        return f"[{link['text']}]({page}{link['anchor'] or ''})"
    return f"`{name}`" if name.endswith(link["text"]) else f"{link['text']} (`{name}`)"


def _mathml(found: re.Match[str]) -> str:
    display = "block" if found["open"] == "[" else "inline"
    formula: str = convert(html.unescape(found["latex"]).strip(), display=display)
    return f"<{found['tag']}>{formula}</{found['tag']}>"

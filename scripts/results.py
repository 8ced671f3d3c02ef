"""Tables and figures of the pages of results, written from the data files that the measuring commands left.

    python scripts/results.py            # write every table and figure into its page again
    python scripts/results.py --check    # say which pages differ from their data, and exit with 1
    python scripts/results.py record PAGE/TABLE --seeds "1 to 5" -- COMMAND ...

``docs/results/data/PAGE/TABLE.json`` holds one table with the command, the seeds, the day, the revision and
the machine that made it. A page names a table in a comment, and the generator fills the space below it:

    <!-- table: changes/reporting -->

    <!-- end -->

The lines of the front page are ``sentences`` of the table ``front/figures``. Each names its figures in braces
by the first cell of a row, and the generator puts in the second cell. The comment of such lines is
``<!-- sentences: front/figures -->``.

``record`` runs a command, reads its last Markdown table, or a list of rows in JSON, from the output and
writes the data file. ``source`` is then ``measured``. Older figures, of which the output is not kept, were
typed once from the page that showed them: their ``source`` is ``recorded``.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs" / "results" / "data"
#: A machine on which fewer processes than this were waiting, for each core, counts as quiet.
QUIET_LOAD = 0.5
_TABLE = re.compile(r"(<!-- table: (?P<name>[\w/-]+) -->)\n.*?(?=<!-- end -->)", re.DOTALL)
_SENTENCES = re.compile(r"(<!-- sentences: (?P<name>[\w/-]+) -->)\n.*?(?=<!-- end -->)", re.DOTALL)
_LINE = 120


def pages() -> Iterator[Path]:
    """Yield the files that may show tables or figures of the data."""
    yield ROOT / "README.md"
    yield from sorted((ROOT / "docs").rglob("*.md"))


def load(name: str, data: Path = DATA) -> dict[str, Any]:
    """Return a table by its name ``PAGE/TABLE``."""
    path = data / f"{name}.json"
    if not path.is_file():
        raise SystemExit(f"results: {path}: no such table; 'record {name} -- COMMAND' writes it")
    return dict(json.loads(path.read_text(encoding="utf-8")))


def render(text: str, data: Path = DATA) -> str:
    """Return a page with every table and every sentence as its data file has it."""
    text = _TABLE.sub(lambda found: f"{found[1]}\n\n{markdown(load(found['name'], data))}\n\n", text)
    return _SENTENCES.sub(lambda found: f"{found[1]}\n\n{sentences(load(found['name'], data))}\n\n", text)


def markdown(table: Mapping[str, Any]) -> str:
    """Return a table with the line that says what made it."""
    lines = [table["columns"], ["---"] * len(table["columns"]), *table["rows"]]
    if any(len(line) != len(table["columns"]) for line in lines):
        raise SystemExit(f"results: {table['title']}: a row has not as many cells as there are columns")
    body = "\n".join("| " + " | ".join(cell(c) for c in line) + " |" for line in lines)
    return f"{body}\n\n{origin(table)}"


def cell(content: object) -> str:
    """Return a cell as the page shows it; None is an empty cell."""
    if content is None:
        return ""
    if isinstance(content, int) and abs(content) >= 10_000:
        return f"{content:,}"
    return str(content)


def origin(table: Mapping[str, Any]) -> str:
    """Return the line below a table: what made it, when, with which seeds, on which machine."""
    made = f"{table['source'].capitalize()} {table['date']}, revision `{table['revision']}`"
    words = [made, ", ".join(f"`{command}`" for command in table["command"].split("; "))]
    words += [f"seeds {table['seeds']}"] if table["seeds"] else []
    words += [f"machine: {table['machine']}"]
    return f"*{'; '.join(words)}.*"


def sentences(table: Mapping[str, Any]) -> str:
    """Return the sentences of a table as a list, with the figures that they name in braces."""
    figures = {cell(row[0]): cell(row[1]) for row in table["rows"]}
    lines = []
    for sentence in table["sentences"]:
        unknown = set(re.findall(r"{([^}]*)}", sentence)) - set(figures)
        if unknown:
            raise SystemExit(f"results: {table['title']}: no row is named {', '.join(sorted(unknown))}")
        text = re.sub(r"{([^}]*)}", lambda found: figures[found[1]], sentence)
        lines.append(textwrap.fill(f"* {text}", _LINE, subsequent_indent="  ", break_on_hyphens=False))
    return "\n".join(lines)


def read_output(text: str) -> tuple[list[str], list[list[Any]]]:
    """Return columns and rows of what a command printed: rows in JSON, or its last Markdown table."""
    if text.lstrip().startswith(("[", "{")):
        found = json.loads(text)
        rows = found["rows"] if isinstance(found, dict) else found
        columns = list(dict.fromkeys(name for row in rows for name in row))
        return columns, [[row.get(name) for name in columns] for row in rows]
    tables = re.findall(r"(?:^ *\|.*\|[ \t]*\n?){3,}", text, flags=re.MULTILINE)
    if not tables:
        raise SystemExit("results: the command printed neither a Markdown table nor a list of rows in JSON")
    lines = [
        [parsed(c) for c in line.strip().strip("|").split("|")] for line in tables[-1].strip().splitlines()
    ]
    return [cell(c) for c in lines[0]], lines[2:]


def parsed(text: str) -> str | int | float | None:
    """Return a cell as a number where writing that number gives the same text again, else as text."""
    word = text.strip()
    for kind in (int, float):
        try:
            if str(kind(word)) == word:
                return kind(word)
        except ValueError:
            continue
    return word or None


def store(name: str, table: Mapping[str, Any], data: Path = DATA) -> Path:
    """Write a data file with one row of the table on each line."""
    head = {key: content for key, content in table.items() if key != "rows"}
    rows = ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in table["rows"])
    text = json.dumps(head, ensure_ascii=False, indent=1)[:-2] + f',\n "rows": [\n  {rows}\n ]\n}}\n'
    path = data / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def record(name: str, words: Sequence[str], seeds: str, title: str | None, data: Path = DATA) -> Path:
    """Run a command and write the table that it prints as data, with what made it."""
    before = os.getloadavg()[0]
    done = subprocess.run(list(words), capture_output=True, text=True, check=False)
    sys.stderr.write(done.stderr)
    if done.returncode != 0:
        raise SystemExit(f"results: {' '.join(words)}: exit code {done.returncode}; nothing was recorded")
    columns, rows = read_output(done.stdout)
    git = ["git", "describe", "--always", "--dirty", "--abbrev=9", "--exclude=*"]
    revision = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    table = {
        "title": title or name.rpartition("/")[2].replace("-", " "),
        "command": " ".join(words),
        "seeds": seeds,
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "revision": revision,
        "machine": machine(before),
        "source": "measured",
        "columns": columns,
        "rows": rows,
    }
    return store(name, table, data)


def machine(load_before: float) -> str:
    """Return the number of cores and whether other processes used them before the command began."""
    cores = os.cpu_count() or 1
    state = "quiet" if load_before < QUIET_LOAD * cores else f"busy, load {load_before:.1f}"
    return f"{cores} cores, {state}"


def main() -> int:
    """Write the pages, compare them, or record a table."""
    parser = argparse.ArgumentParser(description="Tables of the pages of results, from their data.")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    verbs = parser.add_subparsers(dest="verb")
    recorder = verbs.add_parser("record", help="run a command and keep the table that it prints")
    recorder.add_argument("name", help="PAGE/TABLE")
    recorder.add_argument("--seeds", default="", help="seeds of the surveys, as the page shall name them")
    recorder.add_argument("--title", help="title of the table; its name by default")
    recorder.add_argument("words", nargs="+", help="the command, after --")
    given = parser.parse_args()
    if given.verb == "record":
        print(f"{record(given.name, given.words, given.seeds, given.title)}: written")
    different = [path for path in pages() if render(text := path.read_text(encoding="utf-8")) != text]
    for path in different:
        print(f"{path.relative_to(ROOT)}: {'differs from its data' if given.check else 'written'}")
        if not given.check:
            path.write_text(render(path.read_text(encoding="utf-8")), encoding="utf-8")
    return 1 if given.check and different else 0


if __name__ == "__main__":
    sys.exit(main())

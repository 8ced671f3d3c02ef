"""Commands that the documentation shows: where they stand, which run smaller, and which cannot run here."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Tutorials first: other pages go on with their maps.
ORDER = ("README.md", "docs/tutorials", "docs/how-to", "docs/explanation", "docs/reference")

#: Why a command is not run by the test. This is the only list; the first pattern found in a line counts.
NOT_RUN = {
    r"^subiaco (record|graph live)\b": "drivers of a vehicle; tests/integration/test_live_graph.py",
    r"^subiaco graph (mapping|change)\b": "ROS 2 processes; tests/integration/test_node_graphs.py",
    r"^subiaco .*--scheduler|^dask\b|^DASK_": "a cluster; tests/geo/test_task_runner.py",
    r"^subiaco (train|baseline siamese)": "PyTorch and hours; tests/change/test_learned_commands.py",
    r"\$\{?\w|^(for|do|done)\b|^<": "part of a loop, or names a placeholder",
    r"^python (tests/benchmarks/|scripts/calibrate_confidence)": "measures for hours",
    r"^python docs/tutorials/": "runs in tests/api/test_api.py",
    r"^python scripts/results.py record": "records what is measured; tests/packaging/test_results_pages.py",
    r"^make \w+|^scripts/lock.sh|^docker |docker compose": "sets up or measures for minutes",
    r"^ros2 |^rosdep |^python -m (colcon|pip)|^python3 -m venv": "needs an apt installation of ROS 2",
    r"^git clone|^sudo |^journalctl|^wsl |^cd ": "changes the machine or needs the network",
    r"^(source|export|mkdir|printf|\.) ": "prepares a shell",
}

#: Options that make a run small, added to what is shown; a later option replaces an earlier one.
ONE_TILE = ["--set", "tiles.size=400"]
SMALLER = {
    "change": ["--workers", "1", *ONE_TILE, "--set", "second_registration=false"],
    "map": ["--workers", "1", "--set", "quality.holdout=false"],
    "calibrate": ["--copies", "2"],
    "simulate": ["--preset", "easy", "--duration", "1.1", "--mode", "512x10", "--set", "ground_cell=2.0"],
}


@dataclass(frozen=True)
class Shown:
    """One line of a block of code."""

    page: Path
    line: str

    @property
    def words(self) -> list[str]:
        """Words of the line without comment and redirection."""
        return shlex.split(re.split(r"\s>\s", self.line)[0], comments=True)

    @property
    def redirected(self) -> str | None:
        """Name of the file that takes the output."""
        found = re.search(r"\s>\s*(\S+)", self.line)
        return found[1] if found else None

    @property
    def kind(self) -> tuple[str, ...]:
        """Words that make the run another one; seed, folder and size of a simulation do not."""
        simulation = self.words[:2] == ["subiaco", "simulate"]
        return ("simulate", str("--maps-only" in self.words)) if simulation else tuple(self.words)

    @property
    def name(self) -> str:
        """Page and command, as the name of a test."""
        return f"{self.page.relative_to(ROOT)}: {' '.join(self.words)}"

    def not_run(self) -> str | None:
        """Return why the line is not run, None where it is."""
        return next((why for pattern, why in NOT_RUN.items() if re.search(pattern, self.line)), None)


def blocks(page: Path, languages: str = r"(?:bash|text)?") -> list[str]:
    """Return blocks of code in a page; a block may be indented below a list."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^ *```{languages}\n(.*?)^ *```$", text, flags=re.DOTALL | re.MULTILINE)


def lines(block: str) -> list[str]:
    """Return the commands of a block; continued lines are joined, comments and text are left out."""
    joined = re.sub(r"\\\n\s*", " ", block).splitlines()
    return [line.strip() for line in joined if line.strip() and not line.strip().startswith("#")]


def shown(page: Path) -> list[Shown]:
    """Return the lines of every block of a page that shows commands."""
    command = r"^(?:[A-Z_]+=\S+\s+)*(subiaco|python|make|source|docker|ros2|sudo|git|dask|wsl|scripts/|for) ?"
    found = []
    for block in blocks(page):
        if re.search(command, block.lstrip(), flags=re.MULTILINE):
            found += [Shown(page, line) for line in lines(block)]
    return found


def place(page: Path) -> int:
    """Return the position of a page in the order of the runs."""
    name = page.relative_to(ROOT).as_posix()
    return next((i for i, start in enumerate(ORDER) if name.startswith(start)), len(ORDER))


SHOWN = [line for page in sorted(PAGES, key=place) for line in shown(page)]
#: Every command and script that runs, once, as it stands on the first page that shows it.
RUN = list({line.kind: line for line in reversed(SHOWN) if line.not_run() is None}.values())
RUN = sorted(RUN, key=SHOWN.index)

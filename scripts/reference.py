"""Write the generated pages of the reference as Markdown: ``python scripts/reference.py FOLDER``."""

from __future__ import annotations

import sys
from pathlib import Path

from reference_pages import pages


def main(folder: Path) -> None:
    """Write every page below ``folder``."""
    for name, text in pages().items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
        print(target)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/reference"))

"""Point the CMake exports of the ROS 2 wheels at this interpreter.

The wheels carry paths of the container they were built in
(``/opt/python/cp3XX-cp3XX/...``), and CMake's generation fails on them.
Running this twice changes nothing the second time.
"""

from __future__ import annotations

import re
import sys
import sysconfig
from pathlib import Path

import numpy as np

BUILD_PREFIX = r"/opt/python/cp3\d+-cp3\d+"
REPLACEMENTS = (
    (re.compile(BUILD_PREFIX + r'/lib/[^";]*?/numpy/_?core/include'), np.get_include()),
    (re.compile(BUILD_PREFIX + r"/include/python3\.\d+"), sysconfig.get_paths()["include"]),
)


def patched(text: str) -> str:
    """Return the CMake text with this interpreter's include directories."""
    for pattern, path in REPLACEMENTS:
        text = pattern.sub(lambda _, path=path: path, text)
    return text


def patch_tree(prefix: Path) -> tuple[int, list[Path]]:
    """Rewrite every export below ``prefix``; return the number changed and the files left unresolved."""
    changed, unresolved = 0, []
    for file in sorted(prefix.glob("share/*/cmake/*Export*.cmake")):
        before = file.read_text(encoding="utf-8")
        after = patched(before)
        if after != before:
            file.write_text(after, encoding="utf-8")
            changed += 1
        if re.search(BUILD_PREFIX, after):
            unresolved.append(file)
    return changed, unresolved


def main() -> int:
    """Patch the environment this interpreter belongs to."""
    changed, unresolved = patch_tree(Path(sys.prefix))
    sys.stdout.write(f"  {changed} CMake exports of the ROS 2 wheels rewritten\n")
    for file in unresolved:
        sys.stderr.write(f"error: {file} still names the build container\n")
    return 1 if unresolved else 0


if __name__ == "__main__":
    sys.exit(main())

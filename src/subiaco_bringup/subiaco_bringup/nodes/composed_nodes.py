"""Several nodes of ours in one process."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from importlib import import_module
from typing import Any

from subiaco_bringup.graph import PART
from subiaco_ros.managed_node import Build
from subiaco_ros.node_process import ComposedNode, run_nodes


def parts_of(words: Sequence[str]) -> list[list[str]]:
    """Split arguments into those of each node: name, package, executable, its own."""
    parts: list[list[str]] = []
    for word in words:
        if word == PART:
            parts.append([])
        else:
            parts[-1].append(word)
    return parts


def _building(package: str, executable: str) -> AbstractContextManager[Build]:
    """Return what builds a node: ``building`` of its module where something outlives it, else ``build``."""
    module: Any = import_module(f"{package}.nodes.{executable}")
    found: AbstractContextManager[Build]
    found = module.building() if hasattr(module, "building") else nullcontext(module.build)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run the nodes."""
    with ExitStack() as stack:
        nodes = [
            ComposedNode(name, stack.enter_context(_building(package, executable)), tuple(arguments))
            for name, package, executable, *arguments in parts_of(sys.argv[1:] if argv is None else argv)
        ]
        return run_nodes("composed", nodes)


if __name__ == "__main__":
    sys.exit(main())

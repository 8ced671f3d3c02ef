"""The change node with the pages of the report, which the change package does not know."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial

from subiaco_change.nodes.change_node import build
from subiaco_report.pages import write_pages
from subiaco_ros.node_process import run_node


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node("change", partial(build, write_pages=write_pages), argv)


if __name__ == "__main__":
    sys.exit(main())

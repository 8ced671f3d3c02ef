"""The harness that gives a test nodes in a context and domain of their own."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # the harness beside the tests

from ros_harness import ros

__all__ = ["ros"]

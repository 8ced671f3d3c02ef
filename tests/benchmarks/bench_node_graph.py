# ruff: noqa: T201
"""How far the node graph keeps up with a sensor: replay, odometry and pose graph as processes.

    source ros2_ws/env.sh
    subiaco simulate out/big --preset default --seed 101 --epoch before --mode 2048x10 --duration 20
    python tests/benchmarks/bench_node_graph.py out/big/before

The replay waits for the nodes, so that nothing is lost: seconds of the recording over seconds of the clock
say how far they keep up (1: just so). The first third is left out, while processes start and compile. CPU
seconds by process tell what a quicker or an idler machine would give. Quiet machine, two cores.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import threading
import time
from pathlib import Path

import psutil
from results import keep, rounded

from subiaco_bringup.jobs import run_mapping_graph
from subiaco_geo.bags import BagReader
from subiaco_mapping.request import MappingRequest

_START = 0.33


def cpu_seconds() -> dict[str, float]:
    """Return CPU seconds so far, by node."""
    found: dict[str, float] = {}
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            words, times = process.cmdline(), process.cpu_times()
            name = next((w.rsplit(".", 1)[-1] for w in words if w.endswith("_node")), process.name())
            found[name] = found.get(name, 0.0) + times.user + times.system
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path)
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    given = parser.parse_args()
    with BagReader(given.bag) as reader:
        recorded = (reader.end_ns - reader.start_ns) * 1e-9
    seen: list[tuple[float, float, dict[str, float]]] = []
    lock = threading.Lock()

    def note(stage: str, fraction: float) -> None:
        with lock:
            if stage == "replay":
                seen.append((fraction, time.monotonic(), cpu_seconds()))

    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        settings = {"gnss": {"min_length": 2.0}}
        request = MappingRequest.of(bags=(given.bag,), output=Path(folder) / "map", config=settings)
        run_mapping_graph(request, progress=note)
    print(f"{recorded:.1f} s of recording, {time.monotonic() - begin:.1f} s from start to written map")
    first = next(row for row in seen if row[0] >= _START)
    last = next(row for row in seen if row[0] >= 0.99)
    played, took = (last[0] - first[0]) * recorded, last[1] - first[1]
    print(f"keeps up {played / took:.2f} times ({played:.1f} s in {took:.1f} s)")
    rows: list[dict[str, object]] = [{"node": "all", "times real time": rounded(played / took)}]
    for name, total in last[2].items():
        spent = (total - first[2].get(name, 0.0)) / played
        print(f"  {name}: {spent:.2f} CPU seconds a second of recording")
        rows.append({"node": name, "CPU s a second": rounded(spent)})
    keep(given.json, rows, {}, [f"{played:.1f} s of recording, after the start"])


if __name__ == "__main__":
    main()

"""The page of real recordings: which tables of what a benchmark printed it takes."""

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def load():
    path = ROOT / "tests" / "benchmarks" / "bench_real.py"
    spec = importlib.util.spec_from_file_location("bench_real", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_real"] = module
    spec.loader.exec_module(module)
    return module


def test_the_page_takes_whole_tables_and_no_rows_without_a_head():
    text = "| a | 1 |\n| b | 2 |\n| name | m2 |\n|---|---|\n| a | 1 |\n| b | 2 |\nwords\n| c | 3 |\n"
    assert load().tables(text) == "| name | m2 |\n|---|---|\n| a | 1 |\n| b | 2 |"


def test_every_part_of_the_page_is_a_benchmark_that_is_there():
    for part in load().PARTS.values():
        assert (ROOT / "tests" / "benchmarks" / part.program).is_file()


def test_absent_recordings_are_named(tmp_path):
    outcome = load().run_part("site", tmp_path, tmp_path, 1)
    assert "real_pair_site is not in" in outcome.section()

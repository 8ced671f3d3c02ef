"""Help that teaches: every verb shows an example and the options of the contract."""

from __future__ import annotations

import pytest

from subiaco_bringup.cli.main import EPILOG

VERBS = [
    "simulate",
    "inspect",
    "import",
    "map",
    "calibrate-rig",
    "check",
    "trajectory",
    "change",
    "evaluate",
    "report",
    "review",
    "export",
    "viewer",
    "deliver",
    "baseline",
    "train",
    "ablate",
    "inject",
    "calibrate",
    "record",
    "recover",
    "config",
    "graph",
]
OPTIONS = {
    "simulate": ["--seed", "--preset", "--epoch", "--maps-only", "--duration", "--mode", "--overwrite"],
    "inspect": ["--json"],
    "config": ["--all", "--config", "--set", "--json"],
    "import": ["--metadata", "--gnss", "--imu", "--output", "--overwrite"],
    "calibrate-rig": ["--output", "--config", "--set", "--overwrite"],
    "map": [
        "--output",
        "--full-density",
        "--config",
        "--set",
        "--threads",
        "--overwrite",
        "--quiet",
        "--verbose",
    ],
    "change": [
        "--output",
        "--trajectory-before",
        "--trajectory-after",
        "--transform",
        "--registration",
        "identity",
        "--parcels",
        "--overwrite",
    ],
    "export": ["--to", "copc", "dxf", "--output", "--cloudcompare", "--review", "accepted", "--sections"],
    "deliver": ["CHANGE_DIR", "--output", "--review", "--polygons", "--check", "--cell", "--without-clouds"],
    "viewer": ["CHANGE_DIR", "--open"],
    "review": ["CHANGE_DIR", "reviews.csv", "--json"],
    "check": ["--control", "--crs", "--geoid", "--json"],
    "trajectory": ["--output", "--align", "--json", "--overwrite"],
    "record": ["--output", "--resume", "--duration", "--remap", "--config", "--set", "--quiet", "--verbose"],
    "recover": ["--output", "--in-place", "--thorough", "--json"],
    "baseline": ["dsm|nn|m3c2|c2c", "--output", "--transform", "--registration", "identity", "--overwrite"],
    "train": ["siamese-kpconv", "SURVEYS", "--output", "--validate", "--prepared", "--config", "--set"],
    "evaluate": ["--output", "--json"],
    "report": ["CHANGE_DIR", "--project", "--client", "--logo"],
}


def test_the_command_lists_its_verbs_in_the_order_of_work(command):
    ran = command("--help")
    listed = [line.split()[0] for line in ran.out.split("Commands:")[1].splitlines() if line.startswith("  ")]
    assert ran.code == 0
    assert [verb for verb in listed if verb in VERBS] == VERBS
    assert "..." not in ran.out.split("Commands:")[1].split("A survey in")[0], "no line is cut short"


def test_the_help_of_the_command_teaches_a_survey_and_the_exit_codes(command):
    ran = command("--help")
    assert "  subiaco map bags/demo/before -o out/before\n" in ran.out
    assert "130 interrupted, 143 ended by SIGTERM" in ran.out


def test_no_words_at_all_show_the_help(command):
    ran = command()
    assert "Commands:" in ran.out + ran.err


@pytest.mark.parametrize("verb", [*VERBS, "graph mapping", "graph change"])
def test_every_verb_shows_an_example_that_is_one_of_its_own(command, verb):
    ran = command(*verb.split(), "--help")
    assert ran.code == 0
    assert f"Example: subiaco {verb}" in " ".join(ran.out.split())


@pytest.mark.parametrize("verb", OPTIONS)
def test_options_of_the_contract_are_there_and_each_is_explained(command, verb):
    out = command(verb, "--help").out
    for option in OPTIONS[verb]:
        assert option in out
    for line in out.split("Options:")[1].splitlines():
        if line.startswith("  -"):
            assert len(line.split("  ")) > 2 or "  " in line.strip(), f"{line}: says nothing"


def test_verbs_of_the_epilogue_exist(command):
    for line in EPILOG.splitlines():
        if line.startswith("  subiaco"):
            assert command(line.split()[1], "--help").code == 0

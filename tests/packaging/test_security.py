"""What input must never reach, and what the network must not see unless asked."""

from __future__ import annotations

import ast
import os
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from subiaco_bringup.environment import dds_defaults
from subiaco_geo import config

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = sorted((REPOSITORY / "src").rglob("*.py"))
PICKLES = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "jsonpickle"}
CALLS = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "unsafe_load",
    "full_load",
    "read_pickle",
    "popen",
    "system",
}
METHODS = {"re.compile", "ast.literal_eval", "platform.system"}
LOADERS = {"SafeLoader", "CSafeLoader", "_Loader"}


def offences(tree: ast.AST) -> Iterator[str]:
    """Yield what runs code that somebody else wrote, with the line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            yield from (f"{node.lineno}: import {n}" for n in names if n.split(".")[0] in PICKLES)
        if isinstance(node, ast.Call):
            yield from (f"{node.lineno}: {said}" for said in _of_call(node))


def _of_call(node: ast.Call) -> Iterator[str]:
    whole = ast.unparse(node.func)
    name = whole.rsplit(".", 1)[-1]
    given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    if name in CALLS and whole not in METHODS:
        yield whole
    if given.get("shell", "False") != "False" or given.get("allow_pickle", "False") != "False":
        yield f"{whole}({given})"
    if whole in ("yaml.load", "yaml.load_all"):
        loader = given.get("Loader") or (ast.unparse(node.args[1]) if len(node.args) > 1 else "none")
        if loader.rsplit(".", 1)[-1] not in LOADERS:
            yield f"{whole} with loader {loader}"


def test_no_source_unpickles_evaluates_or_gives_input_to_a_shell() -> None:
    assert len(SOURCES) > 100
    found = {
        f"{file.relative_to(REPOSITORY)}:{said}"
        for file in SOURCES
        for said in offences(ast.parse(file.read_text(encoding="utf-8")))
    }
    assert not found, "write numbers as npz (allow_pickle=False), facts as JSON or YAML"
    assert issubclass(config._Loader, yaml.SafeLoader)


@pytest.mark.parametrize(
    "line",
    [
        "import pickle", "from joblib import load", "eval(text)", "exec(text)", "builtins.eval(text)",
        "os.system(text)", "os.popen(text)", "subprocess.run(text, shell=True)", "yaml.load(text)",
        "yaml.load(text, Loader=yaml.Loader)", "yaml.unsafe_load(text)", "np.load(path, allow_pickle=True)",
        "__import__(name)", "pd.read_pickle(path)", "compile(text, '', 'exec')",
    ],
)  # fmt: skip
def test_the_rule_sees(line: str) -> None:
    assert list(offences(ast.parse(line)))


@pytest.mark.parametrize("line", ["re.compile(text)", "yaml.safe_load(text)", "np.load(path)", "run(words)"])
def test_the_rule_lets_pass(line: str) -> None:
    assert not list(offences(ast.parse(line)))


def test_without_anything_set_only_this_host_hears() -> None:
    given = dds_defaults({})
    profile = ET.parse(given["FASTRTPS_DEFAULT_PROFILES_FILE"]).getroot()
    assert {node.text for node in profile.iter() if node.tag.endswith("}address")} == {"127.0.0.1"}
    assert given["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"


def test_a_middleware_that_does_not_read_the_profile_is_kept_on_this_host() -> None:
    given = dds_defaults({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"})
    assert given == {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def test_what_the_user_set_is_kept() -> None:
    mine = {"FASTRTPS_DEFAULT_PROFILES_FILE": "/mine.xml", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    assert not dds_defaults(mine).keys() & mine.keys()


@pytest.mark.parametrize(
    ("middleware", "expected"), [("", "SYSTEM_DEFAULT"), ("rmw_cyclonedds_cpp", "LOCALHOST")]
)
def test_the_shell_says_the_same(middleware: str, expected: str) -> None:
    if not (REPOSITORY / "ros2_ws/install/.python").is_file():
        pytest.skip("no workspace: run make setup")
    clean = {k: v for k, v in os.environ.items() if k in ("PATH", "HOME")}
    clean |= {"RMW_IMPLEMENTATION": middleware} if middleware else {}
    command = f"source {REPOSITORY}/ros2_ws/env.sh >/dev/null && env -0"
    done = subprocess.run(["bash", "-c", command], env=clean, capture_output=True, text=True, check=True)
    said = dict(entry.split("=", 1) for entry in done.stdout.split("\0") if "=" in entry)
    assert said["ROS_AUTOMATIC_DISCOVERY_RANGE"] == expected
    if not middleware:
        assert Path(said["FASTRTPS_DEFAULT_PROFILES_FILE"]) == REPOSITORY / "config/dds/loopback.xml"


def test_the_profile_of_a_vehicle_adds_its_own_address_and_the_other_hosts_alone() -> None:
    def addresses(name: str) -> set[str | None]:
        root = ET.parse(REPOSITORY / "config/dds" / name).getroot()
        return {node.text for node in root.iter() if node.tag.endswith("}address")}

    assert addresses("vehicle.xml") - addresses("loopback.xml") == {"${SUBIACO_HOST}", "${SUBIACO_PEER}"}

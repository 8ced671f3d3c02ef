"""The set-up: what is pinned, what the scripts decide, what they refuse."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPTS = sorted([*REPOSITORY.glob("scripts/*.sh"), REPOSITORY / ".ci/run", REPOSITORY / "ros2_ws/env.sh"])


def bash(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run with the functions of setup.sh defined."""
    text = f"source {REPOSITORY}/scripts/setup.sh; {command}"
    environment = {"PATH": "/usr/bin:/bin:/usr/sbin:/sbin", **environment}
    return subprocess.run(
        ["bash", "-c", text], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


def fake_python(folder: Path, name: str, version: str | None) -> Path:
    """Make an interpreter that answers the version question, or a shim that only fails."""
    file = folder / name
    accepted = version in ("3.11", "3.12")
    file.write_text(f"#!/bin/sh\nexit {0 if accepted else 1}\n", encoding="utf-8")
    file.chmod(0o755)
    return file


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_the_lock_pins_every_requirement_at_an_allowed_version() -> None:
    from packaging.requirements import Requirement
    from packaging.version import Version

    lock: dict[str, list[Version]] = {}
    for line in (REPOSITORY / "requirements.lock").read_text(encoding="utf-8").splitlines():
        if found := re.match(r"([A-Za-z0-9._-]+)==([^ ;]+)", line):
            lock.setdefault(canonical(found[1]), []).append(Version(found[2]))
    for line in (REPOSITORY / "requirements.in").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            wanted = Requirement(line)
            assert lock.get(canonical(wanted.name)), f"{wanted.name} is not locked"
            assert all(version in wanted.specifier for version in lock[canonical(wanted.name)]), line


def entries_of(text: str) -> dict[str, list[str]]:
    """Lines of every entry of a lock, by the first word of its first line."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line and line[0] not in " #":
            found[line.split()[0]] = entry = [line]
        elif found and line.strip().startswith("--hash"):
            entry.append(line)
    return found


def test_every_locked_package_has_a_hash_and_none_that_the_overrides_leave_out_is_there() -> None:
    entries = entries_of((REPOSITORY / "requirements.lock").read_text(encoding="utf-8"))
    assert all("--hash=sha256:" in "".join(lines) for lines in entries.values())
    names = {canonical(entry.partition("==")[0]) for entry in entries}
    overrides = (REPOSITORY / "requirements.overrides").read_text(encoding="utf-8").splitlines()
    left_out = {line.partition(";")[0].strip() for line in overrides if "never" in line}
    assert left_out
    assert not left_out & names


def test_with_an_apt_ros_the_entries_of_ros_are_left_out_whole() -> None:
    lock = entries_of((REPOSITORY / "requirements.lock").read_text(encoding="utf-8"))
    without = entries_of(bash("locked '!^ros-'").stdout)
    assert without == {name: lines for name, lines in lock.items() if not name.startswith("ros-")}
    assert len(without) < len(lock) == len(entries_of(bash("locked '!^$'").stdout))
    assert list(entries_of(bash("locked '^uv=='").stdout)) == [
        name for name in lock if name.startswith("uv==")
    ]


def test_the_set_up_of_the_demo_leaves_out_tools_alone() -> None:
    lock = entries_of((REPOSITORY / "requirements.lock").read_text(encoding="utf-8"))
    demo = entries_of(bash('SCOPE=demo; locked "$(not_wanted)"').stdout)
    left_out = {name.partition("==")[0] for name in lock.keys() - demo.keys()}
    assert demo == {name: lines for name, lines in lock.items() if name in demo}
    assert {
        "mypy",
        "ruff",
        "hypothesis",
        "mkdocs-material",
        "babel",
        "distributed",
        "foxglove-sdk",
        "uv",
        "colcon-core",
        "ninja",
        "ros-ament-cmake",
    } <= left_out
    # others of what the demo needs ask for them, or import them without asking
    needed = {
        "numpy",
        "jinja2",
        "pygments",
        "pytest",
        "pyarrow",
        "empy",
        "lark-parser",
        "ros-domain-coordinator",
    }
    assert not needed & left_out
    assert entries_of(bash('SCOPE=all; locked "$(not_wanted)"').stdout) == lock


def test_with_an_apt_ros_the_demo_keeps_colcon_which_builds_the_workspace_then(tmp_path: Path) -> None:
    (tmp_path / "setup.bash").touch()
    command = 'SCOPE=demo; locked "$(not_wanted)"'
    names = {n.partition("==")[0] for n in entries_of(bash(command, SUBIACO_APT_ROS=str(tmp_path)).stdout)}
    assert {"colcon-core", "colcon-ros", "catkin-pkg", "ninja"} <= names
    assert not {name for name in names if name.startswith("ros-")} | ({"mypy", "uv"} & names)


def test_a_set_up_of_the_demo_is_completed_and_a_whole_one_serves_the_demo(tmp_path: Path) -> None:
    def serves(built: bool = True) -> list[bool]:
        ask = f"VENV={tmp_path}; is_built() {{ {'true' if built else 'false'}; }}; SCOPE=%s; has_scope"
        return [bash(ask % scope).returncode == 0 for scope in ("all", "demo")]

    assert serves() == serves(built=False) == [False, True]
    (tmp_path / ".slim").touch()
    assert serves() == [False, True]
    assert serves(built=False) == [False, False]  # the headers are gone
    (tmp_path / ".slim").unlink()
    (tmp_path / ".whole").touch()
    assert serves() == serves(built=False) == [True, True]
    assert "give nothing, or demo" in bash("SCOPE=some; main").stderr


def test_only_an_environment_of_the_demo_alone_is_made_slim(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    fake = tmp_path / "bin/python"
    fake.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/said\n', encoding="utf-8")
    fake.chmod(0o755)
    (tmp_path / ".whole").touch()
    bash(f"VENV={tmp_path}; SCOPE=demo; make_slim")
    assert not (tmp_path / "said").exists()
    (tmp_path / ".whole").unlink()
    bash(f"VENV={tmp_path}; SCOPE=demo; make_slim; make_slim")
    assert (tmp_path / "said").read_text().split() == [f"{REPOSITORY}/scripts/slim_venv.py", "--all"]


def test_cmake_is_asked_for_only_where_something_is_built_with_it(tmp_path: Path) -> None:
    (tmp_path / "setup.bash").touch()
    gone = "command() { false; }; missing_system_packages ''"
    assert "cmake" in bash(f"SCOPE=all; {gone}").stdout.split()
    assert "cmake" not in bash(f"SCOPE=demo; {gone}").stdout.split()
    assert "cmake" in bash(f"SCOPE=demo; {gone}", SUBIACO_APT_ROS=str(tmp_path)).stdout.split()


def test_licences_and_bill_of_materials_are_those_of_the_lock_and_without_gpl() -> None:
    entries = entries_of((REPOSITORY / "requirements.lock").read_text(encoding="utf-8"))
    locked = {(canonical(n), v) for n, _, v in (entry.partition("==") for entry in entries)}
    bill = json.loads((REPOSITORY / "docs/sbom.cdx.json").read_text(encoding="utf-8"))
    listed = {(p["name"], p["version"]) for p in bill["components"] if p["purl"].startswith("pkg:pypi/")}
    assert listed <= locked, "renew it: python scripts/licences.py"
    page = (REPOSITORY / "docs/licences.md").read_text(encoding="utf-8")
    elsewhere = set(page.rpartition("machines: ")[2].strip(" .\n").split(", "))
    assert {name for name, _ in locked} == {name for name, _ in listed} | elsewhere
    vendored = re.findall(r"^\| three \| ([\d.]+) \| MIT \| `(.*)` \|$", page, re.MULTILINE)
    assert [f"three.js {v}," in (REPOSITORY / file).read_text("utf-8")[:100] for v, file in vendored] == [
        True
    ]
    licences = {part["name"]: part["licenses"][0]["license"]["name"] for part in bill["components"]}
    assert all(licences.values())
    assert not [n for n, text in licences.items() if re.search(r"\bA?GPL|GNU (Affero )?General Public", text)]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_parses(script: Path) -> None:
    result = subprocess.run(["bash", "-n", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_the_dds_profile_binds_loopback_only() -> None:
    root = ET.parse(REPOSITORY / "config/dds/loopback.xml").getroot()
    addresses = {node.text for node in root.iter() if node.tag.endswith("}address")}
    assert addresses == {"127.0.0.1"}
    builtin = [node.text for node in root.iter() if node.tag.endswith("}useBuiltinTransports")]
    assert builtin == ["false"]


def test_a_shim_that_fails_is_passed_over(tmp_path: Path) -> None:
    fake_python(tmp_path, "python3.12", None)
    expected = fake_python(tmp_path, "python3.11", "3.11")
    result = bash("find_python", PATH=f"{tmp_path}:/usr/bin:/bin")
    assert result.stdout.strip() == str(expected)


def test_the_newer_python_is_preferred(tmp_path: Path) -> None:
    fake_python(tmp_path, "python3.11", "3.11")
    expected = fake_python(tmp_path, "python3.12", "3.12")
    assert bash("find_python", PATH=f"{tmp_path}:/usr/bin:/bin").stdout.strip() == str(expected)


def test_an_interpreter_out_of_range_is_refused_by_name(tmp_path: Path) -> None:
    asked = fake_python(tmp_path, "python3.13", "3.13")
    result = bash("find_python", PYTHON=str(asked))
    assert result.returncode == 1
    assert str(asked) in result.stderr


def test_missing_libraries_are_named_as_debian_packages() -> None:
    result = bash('ldconfig() { echo "	libGL.so.1 (libc6) => /x"; }; missing_system_packages ""')
    names = result.stdout.split()
    assert "libgl1" not in names
    assert {"libegl1", "libusb-1.0-0", "libgomp1", "python3-venv"} <= set(names)


def test_a_library_early_in_a_long_list_is_found() -> None:
    listing = 'ldconfig() { printf "\\tlibGL.so.1 (libc6) => /x\\n%.0s" {1..20000}; }'
    assert bash(f"{listing}; has_library libGL.so.1").returncode == 0
    assert bash(f"{listing}; has_library libGL.so").returncode == 1


def test_who_is_not_root_gets_the_exact_line() -> None:
    command = "missing_system_packages() { echo libegl1; }; apt-get() { echo called; }; id() { echo 1000; }"
    result = bash(f"{command}; require_system_packages")
    assert result.returncode == 1
    assert "sudo apt-get install -y --no-install-recommends --no-upgrade libegl1" in result.stderr
    assert "called" not in result.stdout


@pytest.mark.parametrize(
    ("damage", "sound"),
    [
        ("true", True),
        ("touch $VENV/.installing", False),
        ("rm $VENV/bin/python", False),
        ("VENV=$VENV/../moved", False),
    ],
)
def test_a_venv_is_kept_only_when_whole_and_in_its_place(tmp_path: Path, damage: str, sound: bool) -> None:
    (tmp_path / "venv/bin").mkdir(parents=True)
    (tmp_path / "moved").symlink_to("venv")
    fake_python(tmp_path / "venv/bin", "python", "3.11")
    (tmp_path / "venv/bin/pip").write_text(f"#!{tmp_path}/venv/bin/python\n", encoding="utf-8")
    result = bash(f"VENV={tmp_path}/venv; {damage}; venv_is_sound")
    assert (result.returncode == 0) is sound


def test_an_apt_ros_is_used_and_what_it_has_is_not_built_again(tmp_path: Path) -> None:
    (tmp_path / "share/tf2_msgs").mkdir(parents=True)
    (tmp_path / "setup.bash").touch()
    assert bash("has_apt_ros", SUBIACO_APT_ROS=str(tmp_path)).returncode == 0
    names = bash("interfaces_to_build", SUBIACO_APT_ROS=str(tmp_path)).stdout.split()
    assert names == ["subiaco_msgs", "ouster_sensor_msgs"]
    assert bash("has_apt_ros", SUBIACO_APT_ROS=str(tmp_path / "none")).returncode == 1


def test_compiled_kernels_older_than_the_newest_module_are_removed(tmp_path: Path) -> None:
    for seconds, name in enumerate(("old.nbi", "old.1.nbc", "changed.py", "new.nbi", "new.1.nbc"), start=1):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (seconds, seconds))
    bash(f"remove_old_kernels {tmp_path}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["changed.py", "new.1.nbc", "new.nbi"]


def test_the_digest_sees_contents_and_names_but_not_order(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_text(name, encoding="utf-8")

    def digest(*names: str) -> str:
        return bash(f"ROOT={tmp_path}; digest {' '.join(names)}").stdout

    first = digest("a", "b")
    assert first == digest("b", "a")
    (tmp_path / "b").write_text("changed", encoding="utf-8")
    assert digest("a", "b") != first


@pytest.fixture(scope="module")
def patcher() -> ModuleType:
    spec = importlib.util.spec_from_file_location("patcher", REPOSITORY / "scripts/patch_wheel_cmake.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_wheel_exports_are_pointed_here_once(patcher: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "share/std_msgs/cmake/std_msgs__rosidl_generator_pyExport.cmake"
    file.parent.mkdir(parents=True)
    build = "/opt/python/cp311-cp311"
    numpy = f"{build}/lib/python3.11/site-packages/numpy/_core/include"
    file.write_text(f'INTERFACE "{build}/include/python3.11;{numpy}"\n', encoding="utf-8")
    assert patcher.patch_tree(tmp_path) == (1, [])
    include, numpy_include = file.read_text(encoding="utf-8").split('"')[1].split(";")
    assert (Path(numpy_include) / "numpy/ndarrayobject.h").is_file()
    assert Path(include).name.startswith("python3")
    assert patcher.patch_tree(tmp_path) == (0, [])


def test_an_export_that_still_names_the_build_container_is_reported(
    patcher: ModuleType, tmp_path: Path
) -> None:
    file = tmp_path / "share/x/cmake/xExport.cmake"
    file.parent.mkdir(parents=True)
    file.write_text("/opt/python/cp312-cp312/lib/libsomething.so", encoding="utf-8")
    assert patcher.patch_tree(tmp_path) == (0, [file])

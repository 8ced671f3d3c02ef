"""The packages are ROS packages and pip packages at once, and both say the same."""

from __future__ import annotations

import ast
import re
import runpy
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from subiaco_geo import __version__

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = REPOSITORY / "src"
OURS = sorted(path.parent for path in SOURCES.glob("subiaco*/package.xml"))
PYTHON = [package for package in OURS if (package / "setup.py").exists()]
ALL = [*OURS, *sorted(path.parent for path in (SOURCES / "vendor_msgs").glob("*/package.xml"))]


def name_of(package: Path) -> str:
    return package.name


def setup_arguments(package: Path) -> dict[str, ast.expr]:
    tree = ast.parse((package / "setup.py").read_text(encoding="utf-8"))
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "setup"]
    return {keyword.arg: keyword.value for keyword in calls[0].keywords if keyword.arg}


def test_the_packages_of_the_architecture_are_there() -> None:
    rooms = ("bringup", "change", "evaluation", "geo", "mapping", "msgs", "report", "ros", "sim")
    assert [package.name for package in OURS] == ["subiaco", *(f"subiaco_{room}" for room in rooms)]


@pytest.mark.parametrize("package", ALL, ids=name_of)
def test_a_manifest_names_its_folder_a_maintainer_a_licence_and_a_build_type(package: Path) -> None:
    root = ET.parse(package / "package.xml").getroot()
    assert root.get("format") == "3"
    assert root.findtext("name") == package.name
    assert root.findtext("license") == "Apache-2.0"
    assert "@" in root.find("maintainer").get("email")
    expected = "ament_python" if package in PYTHON else "ament_cmake"
    assert root.findtext("export/build_type") == expected


@pytest.mark.parametrize("package", OURS, ids=name_of)
def test_every_manifest_carries_the_one_version(package: Path) -> None:
    """Wherever they differ: python scripts/version.py X.Y.Z."""
    assert ET.parse(package / "package.xml").findtext("version") == __version__


@pytest.mark.parametrize("package", PYTHON, ids=name_of)
def test_setup_takes_the_version_from_the_manifest(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(package)
    monkeypatch.setattr("setuptools.setup", lambda **given: found.update(given))
    found: dict[str, object] = {}
    runpy.run_path(str(package / "setup.py"))
    assert found["version"] == __version__


def test_the_command_and_the_changelog_name_the_one_version(capsys: pytest.CaptureFixture[str]) -> None:
    from subiaco_bringup.cli.main import run

    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"subiaco {__version__}"
    log = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", log, flags=re.MULTILINE)
    assert released[0][0] == __version__
    assert f"Version {__version__} " in (REPOSITORY / "README.md").read_text(encoding="utf-8")
    assert [day for _, day in released] == sorted((day for _, day in released), reverse=True)


@pytest.mark.parametrize("package", PYTHON, ids=name_of)
def test_setup_and_manifest_agree(package: Path) -> None:
    arguments = setup_arguments(package)
    manifest = ET.parse(package / "package.xml")
    assert ast.literal_eval(arguments["description"]) == manifest.findtext("description")
    assert ast.literal_eval(arguments["license"]) == manifest.findtext("license")


@pytest.mark.parametrize("package", PYTHON, ids=name_of)
def test_every_entry_point_names_a_function_that_exists(package: Path) -> None:
    arguments = setup_arguments(package)
    points = ast.literal_eval(arguments["entry_points"]) if "entry_points" in arguments else {}
    for line in points.get("console_scripts", []):
        module, function = line.split("=")[1].strip().split(":")
        source = package / (module.replace(".", "/") + ".py")
        tree = ast.parse(source.read_text(encoding="utf-8"))
        assert function in {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}, line


@pytest.mark.parametrize("package", PYTHON, ids=name_of)
def test_a_manifest_depends_on_every_room_its_modules_import(package: Path) -> None:
    manifest = ET.parse(package / "package.xml")
    declared = {node.text for tag in ("depend", "exec_depend") for node in manifest.iter(tag)} | {
        package.name
    }
    ros = {p.name for p in ALL} | {
        "rclpy",
        "sensor_msgs",
        "nav_msgs",
        "geometry_msgs",
        "std_msgs",
        "rosgraph_msgs",
    }
    ros |= {
        "diagnostic_msgs",
        "builtin_interfaces",
        "visualization_msgs",
        "std_srvs",
        "action_msgs",
        "rcl_interfaces",
    }
    imported = {top for file in (package / package.name).rglob("*.py") for top in imported_by(file)}
    assert imported & ros <= declared


#: Packages that the modules of a package may import beside itself and, in ``nodes/``, further ones.
ALLOWED: dict[str, tuple[set[str], set[str]]] = {
    "subiaco_geo": (set(), set()),
    "subiaco_ros": ({"subiaco_geo"}, set()),
    "subiaco_sim": ({"subiaco_geo"}, set()),
    "subiaco_mapping": ({"subiaco_geo"}, {"subiaco_ros", "subiaco_msgs"}),
    "subiaco_change": ({"subiaco_geo"}, {"subiaco_ros", "subiaco_msgs"}),
    "subiaco_evaluation": ({"subiaco_geo", "subiaco_change"}, set()),
    "subiaco_report": ({"subiaco_geo", "subiaco_change"}, set()),
}


def imported_by(file: Path) -> set[str]:
    tops = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            tops |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            tops.add(node.module.split(".")[0])
    return tops


@pytest.mark.parametrize("name", ALLOWED)
def test_a_package_imports_only_the_packages_before_it(name: str) -> None:
    modules, nodes = ALLOWED[name]
    for file in (SOURCES / name / name).rglob("*.py"):
        allowed = {name} | modules | (nodes if "nodes" in file.parts else set())
        assert {top for top in imported_by(file) if top.startswith("subiaco_")} <= allowed, file


@pytest.mark.parametrize("name", [name for name in ALLOWED if name != "subiaco_ros"])
def test_only_nodes_import_ros(name: str) -> None:
    for file in (SOURCES / name / name).rglob("*.py"):
        if "nodes" not in file.parts:
            assert not imported_by(file) & {"rclpy", "subiaco_msgs", "subiaco_ros"}, file


@pytest.mark.parametrize("package", OURS, ids=name_of)
def test_the_workspace_links_to_every_package_of_ours(package: Path) -> None:
    link = REPOSITORY / "ros2_ws" / "src" / package.name
    assert link.is_symlink()
    assert not Path(link.readlink()).is_absolute()
    assert link.resolve() == package.resolve()


@pytest.mark.parametrize("package", [p for p in ALL if p not in PYTHON], ids=name_of)
def test_every_interface_file_is_generated(package: Path) -> None:
    listed = (package / "CMakeLists.txt").read_text(encoding="utf-8")
    files = [path for kind in ("msg", "srv", "action") for path in package.glob(f"{kind}/*.{kind}")]
    assert files
    assert all(f'"{path.relative_to(package)}"' in listed for path in files)


def test_the_change_record_has_every_column_of_the_table() -> None:
    text = (SOURCES / "subiaco_msgs/msg/ChangeRecord.msg").read_text(encoding="utf-8")
    fields = {line.split()[1] for line in text.splitlines() if line and not line.startswith("#")}
    columns = (
        "object_id object_class change id_before id_after match_kind delta_h_m delta_v_m3 delta_v_surface_m3 "
        "delta_c_m iou_3d d_perp_m lod95_m observed_fraction evidence score_paper confidence "
        "n_before n_after x y z delta_h_low_m delta_h_high_m delta_v_low_m3 delta_v_high_m3 height_before_m "
        "height_after_m area_m2 footprint reason object_uid"
    )
    assert set(columns.split()) <= fields

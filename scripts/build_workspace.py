"""Build the ROS 2 workspace beside the wheels of ROS 2: messages for Python, and links to our packages.

``colcon`` with CMake takes a minute on two cores for what these wheels need: it starts an interpreter
for every generator of every package, parses each definition a dozen times, and compiles C++ that no Python
node loads. Here the same generators run in one process, and the compiler sees every package's type support
at once. The result has colcon's layout, one prefix a package, so nothing else sees the difference. With an
apt installation of ROS 2 colcon is used instead, which builds for C++ too.

    python scripts/build_workspace.py messages PACKAGE_FOLDER...
    python scripts/build_workspace.py python PACKAGE_FOLDER...
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import importlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

ROOT = Path(__file__).resolve().parents[1]
VENV = Path(sys.prefix)
SHARE = VENV / "share"
INDEX = Path("share/ament_index/resource_index")
SITE = Path("lib", f"python{sys.version_info.major}.{sys.version_info.minor}", "site-packages")
#: What rosidl adds to every service and action without being asked.
IMPLICIT = ("builtin_interfaces", "service_msgs", "unique_identifier_msgs")
#: Those that C messages find at run time by the middleware's name.
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
DESCRIBED = "rosidl_generator_type_description"
KINDS = (".msg", ".srv", ".action")
#: A script in words that sh, bash and zsh understand. Sourcing it twice changes nothing the second time.
SETUP = "# Written by scripts/build_workspace.py: puts what was built here in front of what is there.\n"
EXPORT = """\
case ":${{{name}:-}}:" in
    *":{value}:"*) ;;
    *) export {name}="{value}${{{name}:+:${name}}}" ;;
esac
"""


@dataclass(frozen=True)
class Interfaces:
    """A package of messages: where it is, where it is built and where it goes."""

    source: Path
    build: Path
    prefix: Path

    @property
    def name(self) -> str:
        """Return the name of the package."""
        return self.source.name

    @property
    def files(self) -> list[Path]:
        """Return its definitions, relative to its folder."""
        return sorted(p.relative_to(self.source) for p in self.source.glob("*/*") if p.suffix in KINDS)


def interface_packages(names: Iterable[str]) -> list[str]:
    """Return the packages with messages among those that packages depend on, and theirs, all from wheels."""
    found: list[str] = []
    waiting = [*names, *IMPLICIT]
    while waiting:
        name = waiting.pop()
        if name not in found and (VENV / INDEX / "rosidl_interfaces" / name).is_file():
            found.append(name)
            waiting += depends(SHARE / name / "package.xml")
    return sorted(found)


def depends(manifest: Path) -> list[str]:
    """Return what a package.xml names as its dependencies."""
    tags = ("depend", "build_depend", "exec_depend", "build_export_depend")
    return [node.text or "" for tag in tags for node in ET.parse(manifest).iter(tag)]  # noqa: S314


# ---------------------------------------------------------------- generated sources


def parse_once() -> None:
    """Let every generator share one parse of each definition."""
    parser: Any = importlib.import_module("rosidl_parser.parser")
    parse = parser.parse_idl_file
    parsed: dict[str, Any] = {}

    def remembered(locator: Any, png_file: Any = None) -> Any:
        path = str(locator.get_absolute_path())
        if path not in parsed:
            parsed[path] = parse(locator, png_file)
        return parsed[path]

    parser.parse_idl_file = remembered


class Generator:
    """Runs the generators of rosidl for one package."""

    def __init__(self, package: Interfaces) -> None:
        self.package = package
        adapter: Any = importlib.import_module("rosidl_adapter")
        base = package.build / "rosidl_adapter" / package.name
        with redirect_stdout(StringIO()):
            made = [adapter.convert_to_idl(package.source, package.name, f, base) for f in package.files]
        self.idls = [path.relative_to(base) for path in made]
        self.common: dict[str, Any] = {
            "package_name": package.name,
            "idl_tuples": [f"{base}:{idl}" for idl in self.idls],
            "ros_interface_files": [str(package.source / file) for file in package.files],
            "target_dependencies": [str(path) for path in made],
        }

    def folder(self, generator: str) -> Path:
        """Return where a generator writes: a directory to include from."""
        return self.package.build / generator

    def run(self, generator: str, function: str, *more: Any, **arguments: Any) -> None:
        """Call a function of a generator with a file of arguments, as CMake does."""
        output = self.folder(generator) / self.package.name
        for idl in self.idls:
            (output / idl.parent / "detail").mkdir(parents=True, exist_ok=True)  # as generators expect
        template = SHARE / generator / "resource"
        said = {**self.common, "output_dir": str(output), "template_dir": str(template), **arguments}
        file = self.package.build / f"{generator}__arguments.json"
        file.write_text(json.dumps(said), encoding="utf-8")
        getattr(importlib.import_module(generator), function)(str(file), *more)
        for header in template.glob("*visibility_control.h.in"):
            text = header.read_text(encoding="utf-8")
            text = text.replace("@PROJECT_NAME@", self.package.name)
            text = text.replace("@PROJECT_NAME_UPPER@", self.package.name.upper())
            target = output / "msg" / header.name.removesuffix(".in")
            target.parent.mkdir(exist_ok=True)
            target.write_text(text, encoding="utf-8")

    def describe(self) -> None:
        """Generate the descriptions of types and their hashes."""
        paths = [f"{n}:{SHARE / n}" for n in interface_packages(depends(self.package.source / "package.xml"))]
        self.run(DESCRIBED, "generate_type_hash", include_paths=paths)

    def structures(self) -> None:
        """Generate the structures in C."""
        described = self.folder(DESCRIBED) / self.package.name
        pairs = [f"{idl}:{described / idl.with_suffix('.json')}" for idl in self.idls]
        self.run("rosidl_generator_c", "generate_c", type_description_tuples=pairs)

    def fastrtps(self) -> None:
        """Generate the type support of the middleware."""
        self.run("rosidl_typesupport_fastrtps_c", "generate_typesupport_fastrtps_c")

    def introspection(self) -> None:
        """Generate the type support that other middlewares read, and the one that chooses."""
        self.run("rosidl_typesupport_introspection_c", "generate_c")
        self.run("rosidl_typesupport_c", "generate_c", list(TYPE_SUPPORTS))

    def modules(self) -> None:
        """Generate the Python modules."""
        self.run("rosidl_generator_py", "generate_py", ["rosidl_typesupport_c"])
        (self.folder("rosidl_generator_py") / self.package.name / "__init__.py").touch()


def generate(packages: Sequence[Interfaces]) -> None:
    """Run all generators, on every processor; what was parsed for the descriptions serves the others."""
    generators = [Generator(package) for package in packages]
    for generator in generators:
        generator.describe()
    with ProcessPoolExecutor(os.cpu_count(), get_context("fork")) as pool:
        steps = [g.structures for g in generators] + [g.fastrtps for g in generators]
        steps += [g.modules for g in generators] + [g.introspection for g in generators]
        for step in [pool.submit(step) for step in steps]:
            step.result()


# ---------------------------------------------------------------- compiled libraries


class Compiler:
    """Compiles what the generators wrote for one package into the libraries that rclpy loads."""

    def __init__(self, package: Interfaces) -> None:
        import numpy as np

        self.package = package
        self.needed = interface_packages(depends(package.source / "package.xml"))
        generated = [package.build / name for name in ("rosidl_generator_c", *TYPE_SUPPORTS)]
        include = VENV / "include"
        system = [include, *(path for path in sorted(include.iterdir()) if path.is_dir())]
        system += [Path(sysconfig.get_paths()["include"]), Path(np.get_include())]
        self.flags = ["-fPIC", "-DNDEBUG", "-DFASTCDR_DYN_LINK", f'-DROS_PACKAGE_NAME="{package.name}"']
        self.flags += [f"-I{path}" for path in generated]
        self.flags += [word for path in system for word in ("-isystem", str(path))]

    def objects(self, folder: str, *, together: bool) -> list[list[str]]:
        """Return the commands that compile a folder: a file each, or C++ all together."""
        base = self.package.build / folder
        sources = sorted([*base.rglob("*.c"), *base.rglob("*.cpp")])
        sources = [path for path in sources if path.name != "together.cpp"]
        if together:
            one = base / "together.cpp"
            one.write_text("".join(f'#include "{path}"\n' for path in sources), encoding="utf-8")
            sources = [one]
        commands = []
        for path in sources:
            cpp = path.suffix == ".cpp"
            compiler = ["c++", "-std=gnu++17"] if cpp else ["cc", "-std=gnu11"]
            exported = f"-D{folder.upper()}_BUILDING_DLL_{self.package.name}"
            commands.append([*compiler, "-O1", *self.flags, exported, "-c", str(path), "-o", f"{path}.o"])
        return commands

    def link(self, folder: str, target: Path, *, sources: Sequence[str], against: Sequence[str]) -> list[str]:
        """Return the command that links objects of a folder against libraries, ours by full path."""
        library = self.package.prefix / "lib"
        ours = [str(library / f"lib{self.package.name}__{kind}.so") for kind in against]
        kinds = (folder, *against)
        theirs = [VENV / "lib" / f"lib{name}__{kind}.so" for name in self.needed for kind in kinds]
        common = [
            "rosidl_runtime_c",
            "rosidl_typesupport_c",
            *TYPE_SUPPORTS,
            "rosidl_typesupport_fastrtps_cpp",
        ]
        common += ["rcutils", "rmw", "fastcdr"]
        theirs += [VENV / "lib" / f"lib{name}.so" for name in common]
        linked = [str(path) for path in theirs if path.is_file()]
        rpath = f"-Wl,-rpath,$ORIGIN:{library}:{VENV / 'lib'}"
        return ["c++", "-shared", "-o", str(target), *sources, *ours, "-Wl,--as-needed", *linked, rpath,
                f"-Wl,-soname,{target.name}", f"-Wl,-rpath-link,{VENV / 'lib'}"]  # fmt: skip

    def libraries(self) -> list[tuple[str, tuple[str, ...]]]:
        """Return the libraries, each after those that it is linked against."""
        c = "rosidl_generator_c"
        return [(c, ()), *((kind, (c,)) for kind in TYPE_SUPPORTS), ("rosidl_typesupport_c", (c,)),
                ("rosidl_generator_py", (c, "rosidl_typesupport_c"))]  # fmt: skip


def run(command: list[str]) -> None:
    """Run a compiler; say what it said where it fails."""
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        sys.exit(f"{' '.join(command)}\n{result.stdout}{result.stderr}")


def compile_packages(packages: Sequence[Interfaces]) -> None:
    """Compile and link all packages, on every processor."""
    compilers = [Compiler(package) for package in packages]
    commands: list[list[str]] = []
    for compiler in compilers:
        for folder, _ in compiler.libraries():
            together = folder in ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_c")
            commands += compiler.objects(folder, together=together)
    commands.sort(key=lambda command: "c++" not in command)  # the long ones first
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(run, commands))
        list(pool.map(link_package, compilers))


def link_package(compiler: Compiler) -> None:
    """Link the libraries of a package, and the extension that its Python modules load."""
    package = compiler.package
    library = package.prefix / "lib"
    library.mkdir(parents=True)
    for folder, against in compiler.libraries():
        objects = [
            str(path) for path in sorted((package.build / folder).rglob("*.o")) if "_s.ep." not in path.name
        ]
        target = library / f"lib{package.name}__{folder}.so"
        run(compiler.link(folder, target, sources=objects, against=against))
    modules = package.build / "rosidl_generator_py" / package.name
    extension = modules / f"{package.name}_s__rosidl_typesupport_c.so"
    objects = [str(modules / f"_{package.name}_s.ep.rosidl_typesupport_c.c.o")]
    against = ("rosidl_generator_py", "rosidl_typesupport_c", "rosidl_generator_c")
    run(compiler.link("rosidl_typesupport_c", extension, sources=objects, against=against))


# ---------------------------------------------------------------- prefixes


def write_index(prefix: Path, kind: str, name: str, text: str) -> None:
    """Write an entry of the ament index."""
    path = prefix / INDEX / kind / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def install_messages(package: Interfaces) -> None:
    """Install definitions, descriptions, Python modules and entries of the index; libraries are there."""
    prefix, name = package.prefix, package.name
    share = prefix / "share" / name
    share.mkdir(parents=True)
    shutil.copy2(package.source / "package.xml", share)
    for base in (
        package.source,
        *(package.build / f / name for f in ("rosidl_adapter", DESCRIBED)),
    ):
        for path in sorted(base.glob("*/*")):
            if path.suffix in (*KINDS, ".idl", ".json"):
                (share / path.parent.name).mkdir(exist_ok=True)
                shutil.copy2(path, share / path.parent.name)
    left_out = shutil.ignore_patterns("*.c", "*.o", "detail")
    shutil.copytree(package.build / "rosidl_generator_py" / name, prefix / SITE / name, ignore=left_out)
    listed = sorted({*map(str, package.files), *(str(f.with_suffix(".idl")) for f in package.files)})
    write_index(prefix, "rosidl_interfaces", name, "\n".join(listed))
    write_index(prefix, "packages", name, "")
    write_index(prefix, "package_run_dependencies", name, ";".join(depends(share / "package.xml")))
    write_index(prefix, "parent_prefix_path", name, str(VENV))
    # by this colcon knows what is built already when it builds packages of a workspace over this one
    known = prefix / "share/colcon-core/packages" / name
    known.parent.mkdir(parents=True)
    known.write_text(":".join(depends(share / "package.xml")), encoding="utf-8")
    paths = {
        "AMENT_PREFIX_PATH": [prefix],
        "LD_LIBRARY_PATH": [prefix / "lib"],
        "PYTHONPATH": [prefix / SITE],
    }
    write_scripts(share, "package", paths)


def write_scripts(folder: Path, stem: str, paths: dict[str, list[Path]]) -> None:
    """Write a script to source, for sh, bash and zsh."""
    lines = [EXPORT.format(name=name, value=":".join(map(str, held))) for name, held in paths.items() if held]
    for shell in ("sh", "bash", "zsh"):
        (folder / f"{stem}.{shell}").write_text(SETUP + "".join(lines), encoding="utf-8")


def write_workspace(install: Path) -> None:
    """Write ``local_setup``: all packages of the workspace."""
    prefixes = [path for path in sorted(install.iterdir()) if (path / INDEX / "packages").is_dir()]
    (install / ".colcon_install_layout").write_text("isolated\n", encoding="utf-8")
    write_scripts(install, "local_setup", {
        "AMENT_PREFIX_PATH": prefixes,
        "LD_LIBRARY_PATH": [path / "lib" for path in prefixes if any((path / "lib").glob("*.so"))],
        "PYTHONPATH": [path / SITE for path in prefixes if (path / SITE).is_dir()],
    })  # fmt: skip


# ---------------------------------------------------------------- our Python packages


def described(source: Path) -> Any:
    """Return what a package's setup.py says, without running any command of it."""
    importlib.import_module("setuptools")  # brings distutils, which Python 3.12 no longer has
    core: Any = importlib.import_module("distutils.core")
    with chdir(source):
        return core.run_setup("setup.py", stop_after="init")


def link_python_package(source: Path, install: Path) -> None:
    """Link the files that a package shares, and write its executables where ROS 2 looks for them."""
    said = described(source)
    prefix = install / source.name
    for folder, files in said.data_files:
        target = prefix / folder
        target.mkdir(parents=True, exist_ok=True)
        for file in files:
            (target / Path(file).name).symlink_to(source / file)
    scripts = entry_points(said)
    for name, place in scripts.items():
        write_script(prefix / "lib" / source.name / name, place)
    write_metadata(said, source, scripts)


def entry_points(said: Any) -> dict[str, str]:
    """Return the commands of a package: ``module:function`` by name."""
    pairs = (line.split("=", 1) for line in (said.entry_points or {}).get("console_scripts", ()))
    return {name.strip(): place.strip() for name, place in pairs}


def write_script(path: Path, place: str) -> None:
    """Write an executable that calls ``module:function``."""
    module, _, function = place.partition(":")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"#!{VENV / 'bin/python'}\nimport sys\n\nfrom {module} import {function}\n\n"
        f'if __name__ == "__main__":\n    sys.exit({function}())\n',
        encoding="utf-8",
    )
    path.chmod(0o755)


def write_metadata(said: Any, source: Path, scripts: dict[str, str]) -> None:
    """Describe a package to importlib.metadata and pip: installed, and edited where it is."""
    site = Path(sysconfig.get_paths()["purelib"])
    name, version = said.get_name().replace("-", "_"), said.get_version()
    old_names = (f"{name}-*.dist-info", f"__editable__.{name}-*.pth", f"__editable___{name}_[0-9]*_finder.py")
    for old in [path for pattern in old_names for path in site.glob(pattern)]:
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    folder = site / f"{name}-{version}.dist-info"
    folder.mkdir()
    link = site / f"__editable__.{name}-{version}.pth"
    link.write_text(f"{source}\n", encoding="utf-8")
    with (folder / "METADATA").open("w", encoding="utf-8") as file:
        said.metadata.write_pkg_file(file)
    url = {"url": source.as_uri(), "dir_info": {"editable": True}}
    (folder / "direct_url.json").write_text(json.dumps(url), encoding="utf-8")
    (folder / "INSTALLER").write_text("setup.sh\n", encoding="utf-8")
    lines = "".join(f"{name} = {place}\n" for name, place in scripts.items())
    (folder / "entry_points.txt").write_text(f"[console_scripts]\n{lines}", encoding="utf-8")
    files = [link, *sorted(folder.iterdir())]
    record = [f"{path.relative_to(site)},{checksum(path)},{path.stat().st_size}\n" for path in files]
    record.append(f"{folder.name}/RECORD,,\n")
    (folder / "RECORD").write_text("".join(record), encoding="utf-8")


def checksum(path: Path) -> str:
    """Return the hash of a file as a RECORD has it."""
    digest = base64.urlsafe_b64encode(hashlib.sha256(path.read_bytes()).digest())
    return "sha256=" + digest.rstrip(b"=").decode()


# ---------------------------------------------------------------- command


def build_messages(sources: Sequence[Path], workspace: Path) -> None:
    """Build packages of messages."""
    os.environ["AMENT_PREFIX_PATH"] = str(VENV)
    parse_once()
    packages = [Interfaces(s, workspace / "build" / s.name, workspace / "install" / s.name) for s in sources]
    for package in packages:
        for folder in (package.build, package.prefix):
            shutil.rmtree(folder, ignore_errors=True)
    generate(packages)
    compile_packages(packages)
    for package in packages:
        install_messages(package)
        shutil.rmtree(package.build)


def link_python_packages(sources: Sequence[Path], workspace: Path) -> None:
    """Make our own packages known to ROS 2 and to Python, where they are."""
    for source in sources:
        shutil.rmtree(workspace / "install" / source.name, ignore_errors=True)
        link_python_package(source, workspace / "install")
    commands = entry_points(described(ROOT / "src/subiaco_bringup"))
    write_script(VENV / "bin/subiaco", commands["subiaco"])


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("messages", "python"))
    parser.add_argument("folder", nargs="+", type=Path)
    parser.add_argument("--workspace", type=Path, default=ROOT / "ros2_ws")
    said = parser.parse_args()
    build = build_messages if said.what == "messages" else link_python_packages
    build([folder.resolve() for folder in said.folder], said.workspace.resolve())
    write_workspace(said.workspace.resolve() / "install")


if __name__ == "__main__":
    main()

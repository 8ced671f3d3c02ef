"""Table of licences and software bill of materials of what `make setup` installs.

    python scripts/licences.py      # docs/licences.md, docs/sbom.cdx.json (CycloneDX)

Run in the virtual environment of the project, after `make setup`. A package under the GPL or AGPL,
or one that names no licence, makes the exit code 1.
"""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ET
from importlib.metadata import Distribution, distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Licences that would oblige whoever ships the project: GPL and AGPL, not LGPL.
FORBIDDEN = re.compile(r"\b(A?GPL|GNU (Affero )?General Public)", re.IGNORECASE)
#: Of packages whose metadata names none, or also those of files that are not installed: from their sources.
KNOWN = {
    "docutils": "BSD-2-Clause AND Public Domain",
    "ros-fastcdr": "Apache-2.0",
    "ros-fastrtps": "Apache-2.0",
    "setuptools": "MIT",
}

#: Files of other projects that lie in the repository: version, licence, and where they are.
VENDORED = {
    "three": ("0.187.0", "MIT", "src/subiaco_report/subiaco_report/viewer/static/three.min.js"),
}


def canonical(name: str) -> str:
    """Return the name by which package indexes know a project."""
    return re.sub(r"[-_.]+", "-", name).lower()


def locked() -> dict[str, str]:
    """Return the locked version of every package, for this interpreter and machine where versions differ."""
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    return {canonical(n): v for n, v in re.findall(r"^([A-Za-z0-9._-]+)==([^ ;\\]+)", text, re.MULTILINE)}


def licence_of(found: Distribution) -> str:
    """Return the licence that a package names: expression, classifiers, field, or ROS manifest."""
    name, meta = canonical(found.metadata["Name"]), found.metadata
    if name in KNOWN:
        return KNOWN[name]
    if expression := meta.get("License-Expression"):
        return str(expression)
    classified = [
        c.split("::")[-1].strip() for c in meta.get_all("Classifier") or [] if c.startswith("License ::")
    ]
    classified = [c for c in classified if c != "OSI Approved"]
    if classified:
        return ", ".join(sorted(set(classified)))
    if (named := (meta.get("License") or "").strip().splitlines()) and named[0] != "UNKNOWN":
        return named[0][:60]
    return ros_licence(name)


def ros_licence(name: str) -> str:
    """Return the licence in the manifest of a ROS package that came as a wheel, empty without one."""
    plain = re.sub(r"^ros-(jazzy-)?", "", name).replace("-", "_")
    for manifest in Path(sys.prefix).glob(f"**/share/{plain}/package.xml"):
        licences = ET.parse(manifest).iter("license")  # noqa: S314 (a file of our own environment)
        return ", ".join(sorted({(node.text or "").strip() for node in licences}))
    return ""


def main() -> int:
    """Write both files."""
    versions = locked()
    installed = {canonical(d.metadata["Name"]): d for d in distributions()}
    rows = {n: (d.version, licence_of(d)) for n, d in sorted(installed.items()) if n in versions}
    (ROOT / "docs/licences.md").write_text(table(rows, sorted(set(versions) - set(rows))), encoding="utf-8")
    (ROOT / "docs/sbom.cdx.json").write_text(json.dumps(bill(rows), indent=1) + "\n", encoding="utf-8")
    wrong = [
        f"{n}: {text or 'no licence named'}"
        for n, (_, text) in rows.items()
        if not text or FORBIDDEN.search(text)
    ]
    print("\n".join(wrong) or f"{len(rows)} packages, no GPL or AGPL among them")
    return 1 if wrong else 0


def table(rows: dict[str, tuple[str, str]], elsewhere: list[str]) -> str:
    """Return the page."""
    lines = [
        "# Licences",
        "",
        "Every package that `make setup` installs, with the licence that the package names. Written by",
        "`python scripts/licences.py`; the same list for machines is `sbom.cdx.json` (CycloneDX 1.5).",
        "",
        "| package | version | licence |",
        "|---|---|---|",
        *(f"| {name} | {version} | {text or 'not named'} |" for name, (version, text) in rows.items()),
    ]
    lines += ["", "Files of other projects that lie in the repository, each with its licence beside it:", ""]
    lines += ["| project | version | licence | file |", "|---|---|---|---|"]
    lines += [
        f"| {name} | {version} | {text} | `{path}` |" for name, (version, text, path) in VENDORED.items()
    ]
    if elsewhere:
        lines += ["", f"Locked for other interpreters or machines: {', '.join(elsewhere)}."]
    return "\n".join(lines) + "\n"


def bill(rows: dict[str, tuple[str, str]]) -> dict[str, object]:
    """Return the bill of materials as a CycloneDX 1.5 document."""
    components = [
        {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:pypi/{name}@{version}",
            "licenses": [{"license": {"name": text}}],
        }
        for name, (version, text) in rows.items()
    ]
    components += [
        {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:npm/{name}@{version}",
            "licenses": [{"license": {"name": text}}],
        }
        for name, (version, text, _) in VENDORED.items()
    ]
    subject = {"component": {"type": "application", "name": "subiaco"}}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": subject,
        "components": components,
    }


if __name__ == "__main__":
    sys.exit(main())

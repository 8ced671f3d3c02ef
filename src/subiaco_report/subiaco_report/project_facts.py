"""Project, client and logo in the header of the report, kept beside it."""

from __future__ import annotations

import base64
import json
from pathlib import Path

from subiaco_change.outputs.directory import PROJECT_FACTS
from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError

_KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
_LARGEST_LOGO = 500_000  # [byte]
_EMPTY = {"project": "", "client": "", "logo": ""}


def project_facts(directory: Path) -> dict[str, str]:
    """Return ``project``, ``client`` and ``logo`` (a data URI) of a change directory, empty where not given.

    Raises
    ------
    InputError
        The file is damaged.
    """
    path = directory / PROJECT_FACTS
    if not path.is_file():
        return dict(_EMPTY)
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        return {name: str(known.get(name, "")) for name in _EMPTY}
    except (ValueError, AttributeError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); remove it, or give --project again") from error


def store_project_facts(directory: Path, project: str | None, client: str | None, logo: Path | None) -> None:
    """Store what is given, and keep the rest.

    Raises
    ------
    InputError
        The logo is no PNG, JPEG or WebP, or larger than 500 kB.
    """
    facts = project_facts(directory)
    given = {"project": project, "client": client, "logo": None if logo is None else _data_uri(logo)}
    facts |= {name: value for name, value in given.items() if value is not None}
    with whole_file(directory / PROJECT_FACTS) as path:
        path.write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _data_uri(logo: Path) -> str:
    kind = _KINDS.get(logo.suffix.lower())
    if kind is None or not logo.is_file():
        raise InputError(f"{logo}: no logo; give a .png, .jpg or .webp file")
    if logo.stat().st_size > _LARGEST_LOGO:
        raise InputError(f"{logo}: larger than 500 kB; give a smaller picture")
    return f"data:{kind};base64," + base64.b64encode(logo.read_bytes()).decode("ascii")

"""The page of output files."""

from __future__ import annotations

from reference_pages.file_tables import Folder, folders
from reference_pages.markdown import GENERATED, cell, code, table


def page() -> str:
    """Return the page."""
    parts = [
        "# Output files",
        GENERATED,
        "Every file that a command writes, with its columns. Outputs appear whole, or not at all.",
        *(_folder(folder) for folder in folders()),
    ]
    return "\n\n".join(parts) + "\n"


def _folder(folder: Folder) -> str:
    parts = [f"## {folder.title}", f"Written by {code(folder.command)}. {folder.text}"]
    parts.append(table(("file", "content"), ((code(f.name), cell(f.text)) for f in folder.files)))
    for file in folder.files:
        if file.columns:
            rows = ((code(name), cell(text)) for name, text in file.columns.items())
            parts += [f"### {file.name}", table((file.kind, "meaning"), rows)]
    return "\n\n".join(parts)

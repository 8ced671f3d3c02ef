"""Pages of the reference that are generated from the code when the documentation is built.

Nothing is committed, so that a page cannot differ from the code: ``scripts/docs_hooks.py`` hands the pages to
MkDocs, and ``python scripts/reference.py FOLDER`` writes them as Markdown.
"""

from __future__ import annotations

from reference_pages import commands, files, messages, rules, settings, topics


def pages() -> dict[str, str]:
    """Return the text of every generated page by its path below ``docs``."""
    return {
        "reference/commands.md": commands.page(),
        "reference/messages.md": messages.page(),
        "reference/topics.md": topics.page(),
        "reference/files.md": files.page(),
        "reference/rules.md": rules.page(),
        **{f"reference/{name}.md": text for name, text in settings.pages().items()},
    }

"""Change and class codes of points and table rows: the ones of the published evaluation."""

from __future__ import annotations

from enum import IntEnum


class Change(IntEnum):
    """Point codes of the published evaluation, and the two outcomes beside them."""

    ADDED = 0
    REMOVED = 1
    INCREASED = 2
    DECREASED = 3
    UNCHANGED = 4
    NOT_REPORTED = 254
    UNOBSERVED = 255

    @property
    def label(self) -> str:
        """Name in the table, e.g. ``Added``."""
        return self.name.title().replace("_", "")


#: What an object is that one epoch alone has, and every change.
ONE_EPOCH = (Change.ADDED, Change.REMOVED)
CHANGED = (*ONE_EPOCH, Change.INCREASED, Change.DECREASED)
CHANGED_LABELS = tuple(change.label for change in CHANGED)


class Semantic(IntEnum):
    """Point classes of the published evaluation."""

    GROUND = 0
    BUILDING = 1
    VEGETATION = 2
    MOBILE = 3
    OTHER = 4

    @property
    def label(self) -> str:
        """Name in the table, e.g. ``building``."""
        return self.name.lower()


#: ASPRS classification of LAS 1.4 for each of our classes; 64 is the first user code.
ASPRS_CODES: dict[Semantic, int] = {
    Semantic.GROUND: 2,
    Semantic.BUILDING: 6,
    Semantic.VEGETATION: 5,
    Semantic.MOBILE: 64,
    Semantic.OTHER: 1,
}

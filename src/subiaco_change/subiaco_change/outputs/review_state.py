"""What a review says of a row: accepted, rejected, or something in words of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError

ACCEPTED, REJECTED, OTHER = "accepted", "rejected", "other"
_YES = ("accepted", "accept", "ok", "yes", "y", "true", "correct", "confirmed", "1")
_NO = ("rejected", "reject", "no", "n", "false", "wrong", "0")
_WORDS = dict.fromkeys(_YES, ACCEPTED) | dict.fromkeys(_NO, REJECTED)
#: Selections of rows by their review that exports offer.
SELECTIONS = ("all", "accepted", "not-rejected")
_CHANGED = tuple(c.label for c in (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED))


def review_states(table: pd.DataFrame) -> NDArray[np.str_]:
    """Return ``accepted``, ``rejected``, ``other`` or, without review, the empty string for every row (N,).

    The words that count as a yes or a no are those of :data:`_YES` and :data:`_NO`, in any case. A table
    without the column ``review`` has no reviews.
    """
    if "review" not in table.columns:
        return np.full(len(table), "", dtype=np.str_)
    words = table["review"].fillna("").astype(str).str.strip().str.lower()
    return np.array([_WORDS.get(word, OTHER) if word else "" for word in words], dtype="<U8")


def is_rejected(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell for every row (N,) whether a reviewer rejected it."""
    return np.asarray(review_states(table) == REJECTED)


def selected_by_review(table: pd.DataFrame, selection: str) -> NDArray[np.bool_]:
    """Tell for every row (N,) whether a selection of :data:`SELECTIONS` holds it.

    Raises
    ------
    InputError
        Another word.
    """
    if selection not in SELECTIONS:
        raise InputError(f"--review {selection}: not known; give {', '.join(SELECTIONS)}")
    states = review_states(table)
    if selection == "accepted":
        return np.asarray(states == ACCEPTED)
    return np.asarray(states != REJECTED) if selection == "not-rejected" else np.ones(len(table), dtype=bool)


def review_counts(table: pd.DataFrame) -> dict[str, Any]:
    """Count the changed rows, and how many of them were reviewed, accepted and rejected."""
    states = review_states(table)[table["label"].isin(_CHANGED).to_numpy()]
    return {
        "changed": len(states),
        "reviewed": int(np.count_nonzero(states != "")),
        "accepted": int(np.count_nonzero(states == ACCEPTED)),
        "rejected": int(np.count_nonzero(states == REJECTED)),
        "other": int(np.count_nonzero(states == OTHER)),
    }

"""The change table against its JSON Schema (``change_table.schema.json``)."""

from __future__ import annotations

import json
import re
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd

SCHEMA_FILE = "change_table.schema.json"


@cache
def table_schema() -> dict[str, Any]:
    """Return the JSON Schema of the rows of a change table."""
    text = files("subiaco_change.outputs").joinpath(SCHEMA_FILE).read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


def schema_faults(table: pd.DataFrame) -> list[str]:
    """Compare a table with its schema, column by column.

    Parameters
    ----------
    table : DataFrame
        Rows as they are written; the footprint is not compared.

    Returns
    -------
    list of str
        A line for every column that is missing, unknown, or holds values that the schema does not allow.
    """
    columns: dict[str, dict[str, Any]] = table_schema()["items"]["properties"]
    names = [name for name in table.columns if name != "geometry"]
    found = [f"column {name} is missing" for name in columns if name not in names]
    found += [f"column {name} is not in the schema" for name in names if name not in columns]
    for name in names:
        if name in columns:
            wrong = table.loc[_wrong(table[name], columns[name]), name]
            if len(wrong):
                found.append(f"column {name}: {len(wrong)} values such as {wrong.iloc[0]!r}")
    return found


def _wrong(values: pd.Series, rule: dict[str, Any]) -> pd.Series:
    """Tell which values break a rule of the schema."""
    types = [rule["type"]] if isinstance(rule["type"], str) else rule["type"]
    empty = values.isna()
    if "string" in types:
        text = values.fillna("").astype(str)
        wrong = pd.Series(False, index=values.index)
        if "enum" in rule:
            wrong |= ~text.isin(rule["enum"])
        if "pattern" in rule:
            wrong |= ~text.map(lambda value: re.search(rule["pattern"], value) is not None).astype(bool)
        return wrong
    number = pd.to_numeric(values, errors="coerce")
    low, high = rule.get("minimum", -np.inf), rule.get("maximum", np.inf)
    wrong = ~empty & ~number.between(low, high)
    if "integer" in types and "number" not in types:
        wrong |= ~empty & (number % 1 != 0)
    return wrong | (empty & ("null" not in types))

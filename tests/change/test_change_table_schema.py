"""The data dictionary of the change table is complete, and tables obey its JSON Schema."""

from __future__ import annotations

import json
import math
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from jsonschema import Draft202012Validator

from subiaco_change.outputs.table import (
    ALL_COLUMNS,
    TEXT_COLUMNS,
    build_table,
    read_csv,
    schema_faults,
    write_csv,
)
from subiaco_change.records import ChangeResult
from subiaco_geo.codes import Change, Semantic

PAGE = Path(__file__).resolve().parents[2] / "docs/reference/change-table.md"
SCHEMA = json.loads(
    files("subiaco_change.outputs").joinpath("change_table.schema.json").read_text(encoding="utf-8")
)
COLUMNS: dict[str, dict[str, Any]] = SCHEMA["items"]["properties"]


def _documented() -> dict[str, list[str]]:
    """Return the cells of every row of the page's table by column name."""
    rows = re.findall(r"^\| `([a-z0-9_]+)` \| (.+) \|$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {name: cells.split(" | ") for name, cells in rows}


def _rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    text: str = table.drop(columns="geometry", errors="ignore").to_json(orient="records", double_precision=4)
    return json.loads(text)


def _faults(rows: list[dict[str, Any]]) -> list[str]:
    """Return what the validator of the standard finds, each fault after its column."""
    found = Draft202012Validator(SCHEMA).iter_errors(rows)
    return [f"{fault.json_path.rpartition('.')[2]}: {fault.message}" for fault in found]


def test_writer_schema_and_page_have_the_same_columns_in_the_same_order() -> None:
    assert list(COLUMNS) == list(ALL_COLUMNS)
    assert list(_documented()) == list(ALL_COLUMNS)
    assert SCHEMA["items"]["required"] == list(ALL_COLUMNS)


@pytest.mark.parametrize("name", ALL_COLUMNS)
def test_page_and_schema_say_the_same_of_a_column(name: str) -> None:
    rule, cells = COLUMNS[name], _documented()[name]
    meaning, unit, _, _, empty = cells
    assert (meaning, unit, empty) == (rule["description"], rule["x-unit"], rule["x-empty"])
    assert meaning[0].isupper() or meaning[0] == "9"
    assert meaning.endswith(".")


def test_texts_and_numbers_of_the_writer_are_texts_and_numbers_of_the_schema() -> None:
    assert {n for n, rule in COLUMNS.items() if rule["type"] == "string"} == set(TEXT_COLUMNS)


def test_classes_and_labels_of_the_schema_are_those_of_the_code() -> None:
    assert set(COLUMNS["class"]["enum"]) == {c.label for c in Semantic}
    assert set(COLUMNS["label"]["enum"]) == {c.label for c in Change}


def test_kinds_of_evidence_of_the_schema_are_those_of_the_code() -> None:
    from subiaco_change.visibility_evidence import KINDS

    assert COLUMNS["evidence"]["enum"] == list(KINDS)


def test_every_row_of_a_result_obeys_the_schema_also_after_a_round_trip(
    tmp_path: Path, result: ChangeResult
) -> None:
    table = build_table(result.records, "EPSG:7850", ("2023-02-01", "2025-02-01"))
    write_csv(tmp_path / "changes.csv", table)
    for rows in (_rows(table), _rows(read_csv(tmp_path / "changes.csv"))):
        assert len(rows) == len(result.records)
        assert _faults(rows) == []


@pytest.mark.parametrize(
    ("column", "value"),
    [("label", "Grown"), ("confidence", 1.2), ("n_before", 2.5), ("date_after", "1.2.2025"), ("x", None)],
)
def test_a_wrong_value_is_found(result: ChangeResult, column: str, value: object) -> None:
    rows = _rows(build_table(result.records, "EPSG:7850"))
    rows[0][column] = value
    (fault,) = _faults(rows)
    assert fault.startswith(column)


def test_the_writer_finds_no_fault_in_the_table_of_a_result(result: ChangeResult) -> None:
    assert schema_faults(build_table(result.records, "EPSG:7850", ("2023-02-01", "2025-02-01"))) == []
    assert schema_faults(build_table([], "EPSG:7850")) == []


@pytest.mark.parametrize(
    ("column", "value"),
    [("label", "Grown"), ("confidence", 1.2), ("n_before", 2.5), ("date_after", "1.2.2025"), ("x", math.nan)],
)
def test_the_writer_names_the_column_of_a_wrong_value(
    result: ChangeResult, column: str, value: object
) -> None:
    table = build_table(result.records, "EPSG:7850").astype({"n_before": float})
    table.loc[table.index[0], column] = value
    (fault,) = schema_faults(table)
    assert fault == f"column {column}: 1 values such as {table[column].iloc[0]!r}"


def test_the_writer_names_columns_that_are_missing_or_unknown(result: ChangeResult) -> None:
    table = build_table(result.records, "EPSG:7850").rename(columns={"label": "verdict"})
    assert schema_faults(table) == ["column label is missing", "column verdict is not in the schema"]

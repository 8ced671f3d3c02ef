"""Forms, names of columns and labels of the layers in QGIS, as elements of a style or of a project.

The structure is that of QGIS 3.28 (``QgsVectorLayer::readSymbology``, ``readStyle``).
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

from subiaco_change.outputs.review_state import ACCEPTED, REJECTED
from subiaco_change.outputs.table import ALL_COLUMNS, REVIEW_COLUMNS
from subiaco_geo.codes import Change

_ROWS = ("objects", "ground")  # layers whose features are rows of the change table
_CHANGED = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)
#: What the form offers for the column ``review``: words for people, and the value stored.
_REVIEWS = (("not reviewed", ""), ("accepted", ACCEPTED), ("rejected", REJECTED))
#: Names of columns in tables and forms.
_ALIASES = {
    "object_id": "object", "delta_h_m": "change of height [m]", "delta_v_m3": "change of volume [m³]",
    "observed_fraction": "share observed by the other survey", "lod95_m": "level of detection [m]",
    "height_before_m": "height before [m]", "height_after_m": "height after [m]", "area_m2": "area [m²]",
    "date_before": "day of the earlier survey", "date_after": "day of the later survey",
    "net_m3": "net volume [m³]", "changed_m2": "changed area [m²]",
}  # fmt: skip


def form_elements(layer: str) -> str:
    """Return the elements beside the renderer: widgets, aliases, labels and what a mouse rests on.

    In the layers of the change table only the review columns can be edited; ``review`` offers its values.
    """
    if layer == "parcels":
        return _aliases(("net_m3", "changed_m2", "area_m2")) + _labels("lot", 0)
    if layer not in _ROWS:
        return ""
    fields = "".join(_field(name) for name in ALL_COLUMNS)
    editable = "".join(
        f'<field name="{name}" editable="{int(name in REVIEW_COLUMNS)}"/>' for name in ("fid", *ALL_COLUMNS)
    )
    return (
        f"<fieldConfiguration>{fields}</fieldConfiguration>{_aliases(ALL_COLUMNS)}"
        f"<editable>{editable}</editable><editorlayout>generatedlayout</editorlayout>"
        f"{_labels(_changed_number(), 5000)}"
        '<mapTip>[% "object_id" %]: [% "label" %], [% "class" %]. [% "reason" %]</mapTip>'
    )


def _changed_number() -> str:
    """Expression: label and number of a change that was not rejected."""
    names = ", ".join(f"'{change.label}'" for change in _CHANGED)
    shown = f"\"label\" in ({names}) and coalesce(\"review\", '') <> '{REJECTED}'"
    return f'case when {shown} then "label" || \' \' || "object_id" end'


def _field(name: str) -> str:
    widget = '<editWidget type="TextEdit"><config><Option/></config></editWidget>'
    if name == "review":
        offered = "".join(
            f'<Option type="Map"><Option type="QString" name="{word}" value="{value}"/></Option>'
            for word, value in _REVIEWS
        )
        widget = (
            '<editWidget type="ValueMap"><config><Option type="Map"><Option type="List" name="map">'
            f"{offered}</Option></Option></config></editWidget>"
        )
    elif name == "note":
        widget = (
            '<editWidget type="TextEdit"><config><Option type="Map">'
            '<Option type="bool" name="IsMultiline" value="true"/></Option></config></editWidget>'
        )
    return f'<field name="{name}" configurationFlags="None">{widget}</field>'


def _aliases(names: Sequence[str]) -> str:
    rows = "".join(
        f'<alias index="{index}" field="{name}" name={quoteattr(_ALIASES[name])}/>'
        for index, name in enumerate(names, start=1)
        if name in _ALIASES
    )
    return f"<aliases>{rows}</aliases>"


def _labels(expression: str, least_scale: int) -> str:
    """Labels with a white buffer; beyond a scale of 1 : ``least_scale`` they are hidden, 0 never."""
    is_expression = int(not expression.isidentifier())
    return (
        '<labeling type="simple"><settings calloutType="simple">'
        f'<text-style fieldName={quoteattr(expression)} isExpression="{is_expression}" '
        'fontFamily="Open Sans" fontSize="8" fontSizeUnit="Point" textColor="29,39,51,255" textOpacity="1" '
        'namedStyle="Regular">'
        '<text-buffer bufferDraw="1" bufferSize="0.8" bufferSizeUnits="MM" bufferColor="255,255,255,255" '
        'bufferOpacity="1"/></text-style><placement placement="1" dist="0" priority="5"/>'
        f'<rendering drawLabels="1" scaleVisibility="{int(least_scale > 0)}" scaleMin="{least_scale}" '
        'scaleMax="0" obstacle="1"/></settings></labeling>'
    )

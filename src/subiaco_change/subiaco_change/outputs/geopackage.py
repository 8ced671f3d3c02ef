"""The layers of a GeoPackage, with the styles, forms and labels that QGIS applies by itself.

Colours are those of the paper. The structure is that of QGIS 3.28 (``QgsVectorLayer::readSymbology``,
``readStyle``).
"""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from xml.sax.saxutils import quoteattr

import geopandas as gpd
import pyogrio

from subiaco_change.outputs.reviews import ACCEPTED, REJECTED
from subiaco_change.outputs.table import ALL_COLUMNS, REVIEW_COLUMNS
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import CHANGED, Change, Semantic
from subiaco_geo.errors import InputError

_ROWS = ("objects", "ground")  # layers whose features are rows of the change table
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
    names = ", ".join(f"'{change.label}'" for change in CHANGED)
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


RGB = tuple[int, int, int]
#: What tells of the layer ``coverage`` and of ``coverage.tif``: red, green, blue by ``seen``.
COVERAGE_COLOURS: dict[str, RGB] = {
    "both": (196, 214, 196),
    "only before": (235, 190, 140),
    "only after": (190, 160, 205),
    "undecided": (240, 225, 130),
}
#: Lower bounds of ``net_m3`` of a lot [m3] and its colour: lost orange, gained blue.
_NET: tuple[tuple[float, float, RGB], ...] = (
    (-1e9, -50.0, CHANGE_COLOURS[Change.DECREASED]),
    (-50.0, -5.0, (255, 205, 150)),
    (-5.0, 5.0, (245, 245, 245)),
    (5.0, 50.0, (165, 200, 230)),
    (50.0, 1e9, CHANGE_COLOURS[Change.INCREASED]),
)
#: Expression of QGIS: a row that a reviewer rejected is drawn as an empty outline, whatever its label.
_LABEL_OR_REJECTED = f"case when \"review\" = '{REJECTED}' then '{REJECTED}' else \"label\" end"
_CREATE = """
create table if not exists layer_styles (
  id integer primary key autoincrement not null,
  f_table_catalog text(256), f_table_schema text(256), f_table_name text(256),
  f_geometry_column text(256), styleName text(30), styleQML text, styleSLD text,
  useAsDefault boolean, description text, owner text(30), ui text(30),
  update_time datetime default (strftime('%Y-%m-%dT%H:%M:%fZ','now')))
"""
_REGISTER = """
insert or ignore into gpkg_contents (table_name, data_type, identifier, description)
values ('layer_styles', 'attributes', 'layer_styles', 'QGIS styles')
"""
_INSERT = """
insert into layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column,
  styleName, styleQML, styleSLD, useAsDefault, description, owner)
values ('', '', ?, ?, 'change', ?, '', 1, 'colours of the paper', '')
"""


def renderer(layer: str) -> str:
    """Return the QGIS renderer of a layer.

    ``coverage`` is coloured by what was seen, ``parcels`` by net volume, anything else by ``label``;
    rejected rows are empty outlines.
    """
    if layer == "coverage":
        return _categorised("seen", [(name, rgb, 110) for name, rgb in COVERAGE_COLOURS.items()])
    if layer == "parcels":
        return _graduated("net_m3", _NET)
    faint = (Change.UNCHANGED, Change.NOT_REPORTED, Change.UNOBSERVED)
    entries = [(c.label, CHANGE_COLOURS[c], 60 if c in faint else 150) for c in Change]
    return _categorised(_LABEL_OR_REJECTED, [*entries, (REJECTED, (110, 110, 110), 0)])


def layer_qml(layer: str) -> str:
    """Return the style of a layer of polygons as a QGIS style document."""
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.28" styleCategories="Symbology|Labeling|Fields|Forms|MapTips" labelsEnabled="1">'
        f"{renderer(layer)}{form_elements(layer)}<layerGeometryType>2</layerGeometryType></qgis>"
    )


def _categorised(attribute: str, entries: Sequence[tuple[str, RGB, int]]) -> str:
    names = [quoteattr(name) for name, *_ in entries]
    categories = "".join(
        f'<category render="true" symbol="{i}" value={name} label={name}/>' for i, name in enumerate(names)
    )
    symbols = "".join(_symbol(i, rgb, alpha) for i, (_, rgb, alpha) in enumerate(entries))
    return (
        f'<renderer-v2 type="categorizedSymbol" attr={quoteattr(attribute)} enableorderby="0" '
        f'forceraster="0" symbollevels="0"><categories>{categories}</categories>'
        f"<symbols>{symbols}</symbols></renderer-v2>"
    )


def _graduated(attribute: str, steps: Sequence[tuple[float, float, RGB]]) -> str:
    ranges = "".join(
        f'<range render="true" symbol="{i}" lower="{low:.0f}" upper="{high:.0f}" '
        f"label={quoteattr(_range_name(low, high))}/>"
        for i, (low, high, _) in enumerate(steps)
    )
    symbols = "".join(_symbol(i, rgb, 110) for i, (*_, rgb) in enumerate(steps))
    return (
        f'<renderer-v2 type="graduatedSymbol" attr="{attribute}" graduatedMethod="GraduatedColor" '
        f'enableorderby="0" forceraster="0" symbollevels="0"><ranges>{ranges}</ranges>'
        f"<symbols>{symbols}</symbols></renderer-v2>"
    )


def _range_name(low: float, high: float) -> str:
    if low < -1e6:
        return f"below {high:.0f} m³"
    return f"above {low:.0f} m³" if high > 1e6 else f"{low:.0f} to {high:.0f} m³"


def _symbol(name: int, rgb: RGB, alpha: int) -> str:
    colour = ",".join(str(v) for v in rgb)
    edge = ",".join(str(v * 2 // 3) for v in rgb)
    options = {
        "color": f"{colour},{alpha}",
        "outline_color": f"{edge},255",
        "outline_width": "0.4",
        "outline_width_unit": "MM",
        "style": "solid",
        "outline_style": "solid",
    }
    rows = "".join(f'<Option type="QString" name="{k}" value="{v}"/>' for k, v in options.items())
    return (
        f'<symbol type="fill" name="{name}" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">{rows}</Option>'
        "</layer></symbol>"
    )


def embed_styles(path: Path, layers: Iterable[str]) -> None:
    """Add a default style for every layer to the GeoPackage's ``layer_styles``."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(_CREATE)
        connection.execute(_REGISTER)
        for layer in layers:
            query = "select column_name from gpkg_geometry_columns where table_name = ?"
            (column,) = connection.execute(query, (layer,)).fetchone()
            connection.execute(_INSERT, (layer, column, layer_qml(layer)))


def write_geopackage(path: Path, table: gpd.GeoDataFrame) -> None:
    """Write layers ``objects`` and ``ground``, with styles that QGIS applies by itself."""
    is_ground = table["class"] == Semantic.GROUND.label
    for layer, rows in (("objects", table[~is_ground]), ("ground", table[is_ground])):
        write_layer(path, layer, rows)
    embed_styles(path, ("objects", "ground"))


def layers_of(package: Path) -> set[str]:
    """Return the names of the layers of a GeoPackage.

    Raises
    ------
    InputError
        The file is missing or damaged.
    """
    if not package.is_file():
        raise InputError(f"{package}: the file is missing; run 'subiaco change' again")
    try:
        return {str(name) for name in pyogrio.list_layers(package)[:, 0]}
    except (pyogrio.errors.DataSourceError, OSError) as error:
        said = " ".join(str(error).split())[-200:]
        raise InputError(f"{package}: cannot be read ({said}); repair it in QGIS or move it away") from error


def write_layer(package: Path, name: str, frame: gpd.GeoDataFrame) -> None:
    """Add a layer of polygons to a GeoPackage, or replace it."""
    with warnings.catch_warnings():  # a local map has no CRS, and says so elsewhere
        warnings.filterwarnings("ignore", message="'crs' was not provided")
        frame.to_file(package, layer=name, driver="GPKG", engine="pyogrio", geometry_type="MultiPolygon")

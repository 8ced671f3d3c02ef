"""QGIS styles embedded in a GeoPackage, so that the table opens in the paper's colours."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from xml.sax.saxutils import quoteattr

from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import Change

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
values ('', '', ?, ?, 'change', ?, '', 1, 'change labels in the colours of the paper', '')
"""


def categorised_qml() -> str:
    """Return a QGIS style that fills polygons by ``label``."""
    categories, symbols = [], []
    for index, change in enumerate(Change):
        label = quoteattr(change.label)
        categories.append(f'<category render="true" symbol="{index}" value={label} label={label}/>')
        symbols.append(_symbol(index, CHANGE_COLOURS[change], change is Change.UNCHANGED))
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.28" styleCategories="Symbology">'
        '<renderer-v2 type="categorizedSymbol" attr="label" enableorderby="0" '
        'forceraster="0" symbollevels="0">'
        f"<categories>{''.join(categories)}</categories><symbols>{''.join(symbols)}</symbols>"
        "</renderer-v2><layerGeometryType>2</layerGeometryType></qgis>"
    )


def _symbol(name: int, rgb: tuple[int, int, int], faint: bool) -> str:
    red, green, blue = rgb
    colour, alpha = f"{red},{green},{blue}", 60 if faint else 150
    options = {
        "color": f"{colour},{alpha}",
        "outline_color": f"{colour},255",
        "outline_width": "0.4",
        "outline_width_unit": "MM",
        "style": "solid",
        "outline_style": "solid",
    }
    rows = "".join(f'<Option type="QString" name="{k}" value="{v}"/>' for k, v in options.items())
    props = "".join(f'<prop k="{k}" v="{v}"/>' for k, v in options.items())
    return (
        f'<symbol type="fill" name="{name}" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">{rows}</Option>{props}'
        "</layer></symbol>"
    )


def embed_styles(path: Path, layers: Iterable[str]) -> None:
    """Add a default style for every layer to the GeoPackage's ``layer_styles``."""
    qml = categorised_qml()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(_CREATE)
        connection.execute(_REGISTER)
        for layer in layers:
            query = "select column_name from gpkg_geometry_columns where table_name = ?"
            (column,) = connection.execute(query, (layer,)).fetchone()
            connection.execute(_INSERT, (layer, column, qml))

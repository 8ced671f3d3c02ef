"""``changes.qgs``: a QGIS project that opens a change directory in the paper's colours.

Written as XML in the structure of QGIS 3.28 (``QgsProject``, ``QgsMapLayer::readLayerXml``), without QGIS.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyogrio
from pyproj import CRS

from subiaco_change.outputs.raster import COVERAGE
from subiaco_change.outputs.style import COVERAGE_COLOURS, RGB, renderer
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import Change

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
#: Name of the project in a change directory.
PROJECT = "changes.qgs"
_VERSION = "3.28.0-Firenze"
_VECTOR = ("ground", "objects", "parcels", "coverage")  # from top to bottom
_LOD_STEPS = ((0.0, (68, 1, 84)), (0.05, (59, 82, 139)), (0.1, (33, 145, 140)), (0.2, (253, 231, 37)))
_DZ_STEPS = (
    (-0.5, CHANGE_COLOURS[Change.DECREASED]),
    (0.0, (245, 245, 245)),
    (0.5, CHANGE_COLOURS[Change.INCREASED]),
)


@dataclass(frozen=True)
class _Layer:
    """One layer: its name for people, source beside the project, kind, provider, and its style as XML."""

    name: str
    source: str
    kind: str
    provider: str
    style: str
    shown: bool = True

    @property
    def id(self) -> str:
        """What the layer tree refers to."""
        return "subiaco_" + "".join(c if c.isalnum() else "_" for c in self.source)


def write_project(directory: Path, crs: str | None, bounds: Sequence[float]) -> Path:
    """Write ``changes.qgs`` for the files that a change directory has.

    Parameters
    ----------
    directory : Path
        With ``changes.gpkg``; rasters and LAZ files where they exist.
    crs : str or None
        As pyproj understands it; None for local coordinates.
    bounds : (float, float, float, float)
        West, south, east, north of what the project opens on [m].
    """
    root = ET.Element("qgis", version=_VERSION, projectname="Subiaco changes")
    ET.SubElement(root, "homePath", path="")
    ET.SubElement(root, "title").text = "Changes between two surveys"
    system = _system(crs)
    if system is not None:
        ET.SubElement(root, "projectCrs").append(system)
    layers = _layers(directory)
    tree = ET.SubElement(root, "layer-tree-group")
    for layer in layers:
        _tree_entry(tree, layer)
    _canvas(root, bounds, system)
    held = ET.SubElement(root, "projectlayers")
    for layer in layers:
        held.append(_map_layer(layer, system))
    order = ET.SubElement(root, "layerorder")
    for layer in layers:
        ET.SubElement(order, "layer", id=layer.id)
    _relative_paths(root)
    ET.indent(root, " ")
    path = directory / PROJECT
    path.write_text(_DOCTYPE + ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return path


def _layers(directory: Path) -> list[_Layer]:
    """Layers of the files that are there, from top to bottom."""
    named = set(pyogrio.list_layers(directory / "changes.gpkg")[:, 0])
    layers = [
        _Layer(name, f"./changes.gpkg|layername={name}", "vector", "ogr", renderer(name), name != "coverage")
        for name in _VECTOR
        if name in named
    ]
    seen = [(code, name, COVERAGE_COLOURS[name]) for code, name in COVERAGE.items() if name != "neither"]
    rest = (
        _Layer("ground change [m]", "./ground_change.tif", "raster", "gdal", _ramp(_DZ_STEPS), shown=False),
        _Layer("level of detection [m]", "./lod95.tif", "raster", "gdal", _ramp(_LOD_STEPS), shown=False),
        _Layer("seen by (raster)", "./coverage.tif", "raster", "gdal", _palette(seen), shown=False),
        _Layer("points after", "./after_labelled.laz", "point-cloud", "pdal", _point_colours(), shown=False),
        _Layer(
            "points before", "./before_labelled.laz", "point-cloud", "pdal", _point_colours(), shown=False
        ),
    )
    return layers + [layer for layer in rest if (directory / layer.source).is_file()]


def _tree_entry(tree: ET.Element, layer: _Layer) -> None:
    ET.SubElement(
        tree,
        "layer-tree-layer",
        id=layer.id,
        name=layer.name,
        source=layer.source,
        providerKey=layer.provider,
        checked="Qt::Checked" if layer.shown else "Qt::Unchecked",
        expanded="1" if layer.shown else "0",
    )


def _canvas(root: ET.Element, bounds: Sequence[float], system: ET.Element | None) -> None:
    canvas = ET.SubElement(root, "mapcanvas", name="theMapCanvas", annotationsVisible="1")
    ET.SubElement(canvas, "units").text = "meters"
    extent = ET.SubElement(canvas, "extent")
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), np.asarray(bounds, np.float64), strict=True):
        ET.SubElement(extent, name).text = f"{value:.3f}"
    ET.SubElement(canvas, "rotation").text = "0"
    if system is not None:
        ET.SubElement(canvas, "destinationsrs").append(system)


def _map_layer(layer: _Layer, system: ET.Element | None) -> ET.Element:
    element = ET.Element("maplayer", type=layer.kind, hasScaleBasedVisibilityFlag="0")
    if layer.kind == "vector":
        element.attrib |= {"geometry": "Polygon", "wkbType": "MultiPolygon"}
    ET.SubElement(element, "id").text = layer.id
    ET.SubElement(element, "datasource").text = layer.source
    ET.SubElement(element, "layername").text = layer.name
    if system is not None:
        ET.SubElement(element, "srs").append(system)
    provider = ET.SubElement(element, "provider")
    provider.text = layer.provider
    if layer.kind == "vector":
        provider.set("encoding", "UTF-8")
    element.append(ET.fromstring(layer.style))  # noqa: S314 (our own text)
    ET.SubElement(element, "blendMode").text = "0"
    ET.SubElement(element, "layerOpacity").text = "1"
    return element


def _system(crs: str | None) -> ET.Element | None:
    if crs is None:
        return None
    known = CRS.from_user_input(crs)
    flat = known.sub_crs_list[0] if known.is_compound else known
    authority = flat.to_authority()
    element = ET.Element("spatialrefsys", nativeFormat="Wkt")
    texts = {
        "wkt": flat.to_wkt(),
        "authid": ":".join(authority) if authority else "",
        "srid": authority[1] if authority and authority[1].isdigit() else "0",
        "description": flat.name,
        "ellipsoidacronym": "",
        "geographicflag": "true" if flat.is_geographic else "false",
    }
    for name, text in texts.items():
        ET.SubElement(element, name).text = text
    return element


def _relative_paths(root: ET.Element) -> None:
    paths = ET.SubElement(ET.SubElement(root, "properties"), "Paths")
    ET.SubElement(paths, "Absolute", type="bool").text = "false"


def _hex(rgb: RGB) -> str:
    return "#" + "".join(f"{v:02x}" for v in rgb)


def _palette(entries: Sequence[tuple[int, str, RGB]]) -> str:
    rows = "".join(
        f'<paletteEntry value="{value}" color="{_hex(rgb)}" alpha="255" label="{name}"/>'
        for value, name, rgb in entries
    )
    return (
        '<pipe><rasterrenderer type="paletted" band="1" opacity="0.6" alphaBand="-1" nodataColor="">'
        f"<rasterTransparency/><colorPalette>{rows}</colorPalette></rasterrenderer></pipe>"
    )


def _ramp(steps: Sequence[tuple[float, RGB]]) -> str:
    low, high = steps[0][0], steps[-1][0]
    rows = "".join(
        f'<item value="{value}" color="{_hex(rgb)}" alpha="255" label="{value:+.2f} m"/>'
        for value, rgb in steps
    )
    return (
        f'<pipe><rasterrenderer type="singlebandpseudocolor" band="1" opacity="0.8" alphaBand="-1" '
        f'nodataColor="" classificationMin="{low}" classificationMax="{high}"><rasterTransparency/>'
        f'<rastershader><colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0" '
        f'minimumValue="{low}" maximumValue="{high}">{rows}</colorrampshader></rastershader>'
        "</rasterrenderer></pipe>"
    )


def _point_colours() -> str:
    """Colours of the LAZ itself, 16 bit as LAS has them, which are those of the paper."""
    parts = "".join(
        f"<{name}ContrastEnhancement><minValue>0</minValue><maxValue>65535</maxValue>"
        f"<algorithm>StretchToMinimumMaximum</algorithm></{name}ContrastEnhancement>"
        for name in ("red", "green", "blue")
    )
    return (
        '<renderer type="rgb" red="Red" green="Green" blue="Blue" pointSize="1" pointSizeUnit="MM">'
        f"{parts}</renderer>"
    )

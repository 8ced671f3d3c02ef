"""``changes.qgs``: a QGIS project that opens a change directory in the paper's colours.

Written as XML in the structure of QGIS 3.28 (``QgsProject``, ``QgsMapLayer::readLayerXml``), without QGIS.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from pyproj import CRS

from subiaco_change.outputs.geopackage import COVERAGE_COLOURS, RGB, form_elements, layers_of, renderer
from subiaco_change.outputs.rasters import COVERAGE
from subiaco_change.outputs.reviews import ACCEPTED
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import Change

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
#: Name of the project in a change directory.
PROJECT = "changes.qgs"
_VERSION = "3.28.0-Firenze"
#: Layers of the GeoPackage, from top to bottom: name in the file, name for people, group, shown or not.
_VECTOR = (
    ("ground", "Changed ground", "Changes", True),
    ("objects", "Objects", "Changes", True),
    ("parcels", "Changes by lot", "Lots", True),
    ("coverage", "What each survey saw", "Coverage and accuracy", False),
)
#: Layer that shows what a reviewer accepted, and the rows that it takes.
_ACCEPTED = f"|subset=\"review\" = '{ACCEPTED}'"
_LOD_STEPS = ((0.0, (68, 1, 84)), (0.05, (59, 82, 139)), (0.1, (33, 145, 140)), (0.2, (253, 231, 37)))
_DZ_STEPS = (
    (-0.5, CHANGE_COLOURS[Change.DECREASED]),
    (0.0, (245, 245, 245)),
    (0.5, CHANGE_COLOURS[Change.INCREASED]),
)


@dataclass(frozen=True)
class _Layer:
    """One layer: its name for people, its group, source beside the project, kind, provider, and style as XML.

    ``form`` holds the elements of :func:`~subiaco_change.outputs.geopackage.form_elements`.
    """

    name: str
    group: str
    source: str
    kind: str
    provider: str
    style: str
    shown: bool = False
    form: str = ""

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
    for name, members in groupby(layers, key=lambda layer: layer.group):
        group = ET.SubElement(tree, "layer-tree-group", name=name, checked="Qt::Checked", expanded="1")
        for layer in members:
            _tree_entry(group, layer)
    _canvas(root, bounds, system)
    held = ET.SubElement(root, "projectlayers")
    for layer in layers:
        held.append(_map_layer(layer, system))
    order = ET.SubElement(root, "layerorder")
    for layer in layers:
        ET.SubElement(order, "layer", id=layer.id)
    _properties(root, projected=system is not None)
    ET.indent(root, " ")
    path = directory / PROJECT
    path.write_text(_DOCTYPE + ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return path


def _layers(directory: Path) -> list[_Layer]:
    """Layers of the files that are there, from top to bottom."""
    named = layers_of(directory / "changes.gpkg")
    vectors = [
        _vector_layer(name, title, group, shown) for name, title, group, shown in _VECTOR if name in named
    ]
    accepted = replace(
        _vector_layer("objects", "Accepted changes", "Changes", shown=False),
        source=f"./changes.gpkg|layername=objects{_ACCEPTED}",
    )
    layers = [*vectors[:2], accepted, *vectors[2:]]
    seen = [(code, name, COVERAGE_COLOURS[name]) for code, name in COVERAGE.items() if name != "neither"]
    known, points = "Coverage and accuracy", "Point clouds"
    ramps = (
        ("Level of detection [m]", "./lod95.tif", _ramp(_LOD_STEPS)),
        ("What each survey saw, cells", "./coverage.tif", _palette(seen)),
        ("Change of ground height [m]", "./ground_change.tif", _ramp(_DZ_STEPS)),
    )
    clouds = (
        ("Points of the later survey", "./after_labelled.laz"),
        ("Points of the earlier survey", "./before_labelled.laz"),
    )
    rest = [_Layer(name, known, source, "raster", "gdal", style) for name, source, style in ramps]
    rest += [_Layer(n, points, source, "point-cloud", "pdal", _point_colours()) for n, source in clouds]
    return layers + [layer for layer in rest if (directory / layer.source).is_file()]


def _vector_layer(name: str, title: str, group: str, shown: bool) -> _Layer:
    source = f"./changes.gpkg|layername={name}"
    return _Layer(title, group, source, "vector", "ogr", renderer(name), shown, form_elements(name))


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
        element.set("labelsEnabled", str(int("<labeling" in layer.form)))
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
    element.extend(ET.fromstring(f"<form>{layer.form}</form>"))  # noqa: S314 (our own text)
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


def _properties(root: ET.Element, *, projected: bool) -> None:
    """Relative paths; and that the project has a CRS, without which QGIS ignores ``projectCrs``."""
    properties = ET.SubElement(root, "properties")
    ET.SubElement(ET.SubElement(properties, "Paths"), "Absolute", type="bool").text = "false"
    system = ET.SubElement(properties, "SpatialRefSys")
    ET.SubElement(system, "ProjectionsEnabled", type="int").text = str(int(projected))


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

"""Metadata of a delivery in the XML of ISO 19139 (ISO 19115), which catalogues read."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

from pyproj import CRS, Transformer

_GMD, _GCO = "http://www.isotc211.org/2005/gmd", "http://www.isotc211.org/2005/gco"


@dataclass(frozen=True)
class DeliveryFacts:
    """What the metadata say.

    ``bounds``: west, south, east, north in ``crs`` [m]; ``days``: of both surveys, empty where not known;
    ``accuracy_m``: level of detection at 95 %, None where not known; ``created``: day, ISO 8601.
    """

    identifier: str
    title: str
    abstract: str
    organisation: str
    created: str
    crs: str | None
    bounds: tuple[float, float, float, float]
    days: tuple[str, ...]
    lineage: str
    accuracy_m: float | None


def iso_metadata(facts: DeliveryFacts) -> str:
    """Return the metadata as an XML document; a local CRS has neither reference system nor extent."""
    ET.register_namespace("gmd", _GMD)
    ET.register_namespace("gco", _GCO)
    root = ET.Element(f"{{{_GMD}}}MD_Metadata")
    _text(root, "fileIdentifier", facts.identifier)
    _text(root, "language", "eng")
    _code(root, "hierarchyLevel", "MD_ScopeCode", "dataset")
    party = _add(root, "contact", "CI_ResponsibleParty")
    _text(party, "organisationName", facts.organisation or "not given")
    _code(party, "role", "CI_RoleCode", "pointOfContact")
    _date(root, "dateStamp", facts.created)
    system = None if facts.crs is None else CRS.from_user_input(facts.crs).to_2d()
    if system is not None:
        authority = system.to_authority()
        name = ":".join(authority) if authority else system.name
        found = _add(root, "referenceSystemInfo", "MD_ReferenceSystem")
        _text(_add(found, "referenceSystemIdentifier", "RS_Identifier"), "code", name)
    _identification(root, facts, system)
    _quality(root, facts)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _identification(root: ET.Element, facts: DeliveryFacts, system: CRS | None) -> None:
    held = _add(root, "identificationInfo", "MD_DataIdentification")
    citation = _add(held, "citation", "CI_Citation")
    _text(citation, "title", facts.title)
    date = _add(citation, "date", "CI_Date")
    _date(date, "date", facts.created)
    _code(date, "dateType", "CI_DateTypeCode", "creation")
    _text(held, "abstract", facts.abstract)
    _text(held, "language", "eng")
    topic = _add(held, "topicCategory", "MD_TopicCategoryCode")  # an enumeration, which has no code list
    topic.text = "imageryBaseMapsEarthCover"
    if system is not None:
        to_degrees = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
        west, south, east, north = to_degrees.transform_bounds(*facts.bounds)
        box = _add(_add(held, "extent", "EX_Extent"), "geographicElement", "EX_GeographicBoundingBox")
        names = ("westBoundLongitude", "eastBoundLongitude", "southBoundLatitude", "northBoundLatitude")
        for name, value in zip(names, (west, east, south, north), strict=True):
            inner = ET.SubElement(ET.SubElement(box, f"{{{_GMD}}}{name}"), f"{{{_GCO}}}Decimal")
            inner.text = f"{value:.6f}"


def _quality(root: ET.Element, facts: DeliveryFacts) -> None:
    quality = _add(root, "dataQualityInfo", "DQ_DataQuality")
    _code(_add(quality, "scope", "DQ_Scope"), "level", "MD_ScopeCode", "dataset")
    if facts.accuracy_m is not None:
        report = _add(quality, "report", "DQ_RelativeInternalPositionalAccuracy")
        _text(report, "measureDescription", "level of detection of a change at 95 %, median [m]")
        value = _add(report, "result", "DQ_QuantitativeResult")
        ET.SubElement(value, f"{{{_GMD}}}valueUnit")
        record = ET.SubElement(ET.SubElement(value, f"{{{_GMD}}}value"), f"{{{_GCO}}}Record")
        record.text = f"{facts.accuracy_m:.4f}"
    days = " and ".join(day for day in facts.days if day)
    lineage = facts.lineage + (f" Surveyed on {days}." if days else "")
    _text(_add(quality, "lineage", "LI_Lineage"), "statement", lineage)


def _add(parent: ET.Element, name: str, kind: str) -> ET.Element:
    return ET.SubElement(ET.SubElement(parent, f"{{{_GMD}}}{name}"), f"{{{_GMD}}}{kind}")


def _text(parent: ET.Element, name: str, text: str) -> None:
    ET.SubElement(ET.SubElement(parent, f"{{{_GMD}}}{name}"), f"{{{_GCO}}}CharacterString").text = text


def _date(parent: ET.Element, name: str, day: str) -> None:
    ET.SubElement(ET.SubElement(parent, f"{{{_GMD}}}{name}"), f"{{{_GCO}}}Date").text = day


def _code(parent: ET.Element, name: str, kind: str, value: str) -> None:
    element = _add(parent, name, kind)
    element.set("codeList", f"http://standards.iso.org/iso/19139/resources/gmxCodelists.xml#{kind}")
    element.set("codeListValue", value)
    element.text = value

"""A calibration as files: ``rig.yaml`` for ``--config``, numbers for programs, a page for people."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from subiaco_geo.atomic import whole_directory
from subiaco_mapping.calibration.rig import Rig, RigCalibration, with_rig
from subiaco_mapping.config import MappingConfig

MARKER = "rig.yaml"
_VERDICTS = {
    "thinner": "The facades are thinner: they bear the calibration out.",
    "unchanged": "The facades are as thick as before: no proof for or against the calibration.",
    "thicker": "THE FACADES ARE THICKER: do not use this rig; record again, with more turns.",
    "no facades": "Too few facades in sight: nothing bears the calibration out; record in a built street.",
}


def rig_parameters(rig: Rig, config: MappingConfig) -> dict[str, Any]:
    """Return the rig in the form of ``config/sensors.yaml``, with the clocks."""
    made = with_rig(config, rig)
    sensors = made.sensors.model_dump(mode="json", exclude_none=True)
    for name in {"lidar", "imu", "gnss"} & set(sensors):
        sensors[name] = {key: [round(v, 6) for v in values] for key, values in sensors[name].items()}
    return {
        "sensors": sensors,
        "deskew": {"imu_time_offset_ns": rig.imu_offset_ns},
        "gnss": {
            "time_offset_ns": rig.gnss_offset_ns,
            "heading_offset_deg": round(rig.heading_offset_deg, 4),
        },
    }


def page(calibration: RigCalibration, name: str) -> str:
    """Return the report as Markdown."""
    facades = calibration.facades
    lines = [
        f"# Rig calibration from {name}",
        "",
        f"{calibration.scans} scans, {calibration.fixes} RTK fixed fixes.",
        "",
        "| parameter | given | found | sigma | |",
        "|---|---|---|---|---|",
    ]
    for p in calibration.parameters:
        state = "" if p.observed else "not observable from this motion: kept as given"
        lines.append(f"| {p.name} [{p.unit}] | {p.given:.3f} | {p.value:.3f} | {p.sigma:.3f} | {state} |")
    lines += ["", "Sigmas are standard deviations; offsets are added to the recorded stamps.", ""]
    lines += [f"* {note}." for note in calibration.notes]
    fitted = ", ".join(f"{key} {value:.4f}" for key, value in calibration.residuals.items())
    lines += [
        "",
        f"Residuals (spread): {fitted or 'none'}.",
        "",
        "## Facades",
        "",
        _VERDICTS[facades.verdict],
    ]
    if facades.cells and facades.verdict != "no facades":
        lines.append(
            f"Median thickness (one sigma) in {facades.cells} cubes that both maps have: "
            f"{facades.before * 1e3:.2f} mm as given, {facades.after * 1e3:.2f} mm as found; "
            f"thinner by {facades.gain:.1%} +- {facades.gain_sigma:.1%} a cube."
        )
    return "\n".join(lines) + "\n"


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Put null for NaN, which JSON does not know."""
    return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}


def write_calibration(
    folder: Path, calibration: RigCalibration, config: MappingConfig, name: str, *, overwrite: bool = False
) -> None:
    """Write ``rig.yaml``, ``calibration.json`` and ``report.md``.

    Raises
    ------
    InputError
        The folder exists, without ``overwrite``.
    """
    verdict = calibration.facades.verdict
    head = f"# Rig calibrated from {name}; facades {verdict}. subiaco map BAG --config {MARKER} -o MAP_DIR\n"
    document = {"/**": {"ros__parameters": rig_parameters(calibration.rig, config)}}
    numbers = {
        "recording": name,
        "parameters": [asdict(parameter) for parameter in calibration.parameters],
        "notes": calibration.notes,
        "residuals": calibration.residuals,
        "facades": _plain(asdict(calibration.facades)),
        "scans": calibration.scans,
        "fixes": calibration.fixes,
    }
    with whole_directory(folder, overwrite=overwrite, marker=MARKER) as fresh:
        (fresh / MARKER).write_text(head + yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
        (fresh / "calibration.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
        (fresh / "report.md").write_text(page(calibration, name), encoding="utf-8")

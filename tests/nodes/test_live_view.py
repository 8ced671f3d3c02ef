"""What the driver sees."""

from __future__ import annotations

import io
import json
from typing import Any

from rich.console import Console

from subiaco_bringup.live_view import LiveView, plain_lines


def status(light: str = "green", level: int = 0, message: str = "ok", undriven: float = float("nan")) -> Any:
    line = {"name": "gnss", "level": level, "message": message, "values": {"state": "float", "HDOP": "1.2"}}
    made = {
        "time_ns": 1,
        "light": light,
        "reasons": [] if light == "green" else ["without_rtk_fixed"],
        "lines": [line],
        "again": 2,
        "counts": {"green": 5, "amber": 1, "red": 2},
        "undriven": undriven,
    }
    return json.loads(json.dumps(made))  # as it comes through the channel


def screen(shown: Any) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120, color_system=None)
    with LiveView(console=console) as view:
        view(shown)
    return out.getvalue()


def test_the_light_its_reason_and_every_sensor_are_on_the_screen() -> None:
    text = screen(status("amber", 1, "without_rtk_fixed: float", 350.0))
    for word in ("AMBER", "without_rtk_fixed", "gnss", "look", "HDOP 1.2", "5 green", "driven again: 2"):
        assert word in text
    assert "of the route undriven: 350 m" in text
    assert "undriven:" not in screen(status())


def test_in_a_log_only_what_changed_is_said() -> None:
    first = status()
    assert plain_lines(first, None) == ["gnss: ok: ok", "street: green"]
    assert plain_lines(status(), first) == []
    silent = status("amber", 2, "gnss_silent: since 1.6 s")
    assert plain_lines(silent, first) == [
        "gnss: bad: gnss_silent: since 1.6 s",
        "street: amber (without_rtk_fixed)",
    ]
    assert plain_lines(status("amber", 2, "gnss_silent: since 2.1 s"), silent) == []


def test_quiet_is_quiet() -> None:
    out = io.StringIO()
    with LiveView(quiet=True, console=Console(file=out, force_terminal=True)) as view:
        view(status())
    assert out.getvalue() == ""

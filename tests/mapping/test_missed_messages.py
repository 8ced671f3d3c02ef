"""Messages that a live drive missed are reported by topic and kind."""

from __future__ import annotations

from subiaco_mapping.nodes.missed_messages import Arrivals, missed_messages


def test_what_was_lost_or_left_out_is_told_by_topic() -> None:
    arrivals = Arrivals()
    take = arrivals.counted("/gnss/fix", lambda _: None)
    for number in (1, 2, 5):
        take(None, {"publication_sequence_number": number})
    arrivals.leave_out("/gnss/fix")
    arrivals.counted("/imu/data", lambda _: None)(None, {"publication_sequence_number": 1})
    said = missed_messages(arrivals.facts())
    assert said == "/gnss/fix 2 lost, 1 left out of 5"


def test_nothing_is_told_where_everything_came() -> None:
    arrivals = Arrivals()
    arrivals.counted("/imu/data", lambda _: None)(None, {"publication_sequence_number": 1})
    assert missed_messages(arrivals.facts()) == ""

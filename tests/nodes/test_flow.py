"""Counting flow control, without ROS."""

from __future__ import annotations

import random

import pytest

from subiaco_mapping.nodes.flow import ConsumedCounter, FlowControl


def test_a_publisher_is_not_ready_before_every_consumer_has_spoken() -> None:
    flow = FlowControl(["a", "b"])
    flow.on_counts("a", ["/x"], [0])
    assert not flow.ready
    assert flow.missing == ("b",)
    flow.on_counts("b", [], [])
    assert flow.ready


def test_the_slowest_consumer_sets_what_is_in_flight() -> None:
    flow = FlowControl(["fast", "slow"], {"/x": 3})
    flow.on_counts("fast", ["/x"], [0])
    flow.on_counts("slow", ["/x"], [0])
    for _ in range(3):
        assert flow.may_publish("/x")
        flow.published("/x")
    flow.on_counts("fast", ["/x"], [3])
    assert flow.in_flight("/x") == 3
    assert not flow.may_publish("/x")
    flow.on_counts("slow", ["/x"], [1])
    assert flow.may_publish("/x")
    assert not flow.settled


def test_a_topic_that_nobody_counts_is_never_held_back() -> None:
    flow = FlowControl(["a"], {"/x": 1})
    flow.on_counts("a", ["/y"], [0])
    for _ in range(10):
        flow.published("/x")
    assert flow.may_publish("/x")
    assert flow.settled


def test_counts_of_strangers_and_old_counts_change_nothing() -> None:
    flow = FlowControl(["a"])
    flow.on_counts("a", ["/x"], [0])
    for _ in range(5):
        flow.published("/x")
    assert not flow.on_counts("stranger", ["/x"], [0])
    assert flow.on_counts("a", ["/x"], [5])
    assert flow.on_counts("a", ["/x"], [2])
    assert flow.settled


def test_what_was_consumed_of_a_replay_before_opens_no_window_for_the_next() -> None:
    flow = FlowControl(["a"], {"/x": 3})
    flow.on_counts("a", ["/x"], [998])
    flow.on_counts("a", ["/x"], [1000])  # the last of the replay before
    for _ in range(3):
        assert flow.may_publish("/x")
        flow.published("/x")
    assert not flow.may_publish("/x")
    flow.on_counts("a", ["/x"], [1001])
    assert flow.in_flight("/x") == 2
    flow.on_counts("a", ["/x"], [1003])
    assert flow.settled


@pytest.mark.parametrize("seed", range(5))
def test_a_bounded_queue_never_overflows_whatever_the_timing(seed: int) -> None:
    chance = random.Random(seed)
    window = 8
    flow, counter = FlowControl(["c"], {"/x": window}), ConsumedCounter(["/x"], batch=3)
    queue, sent, largest = 0, 0, 0
    flow.on_counts("c", list(counter.take()), [0])
    while sent < 500 or queue:
        if chance.random() < 0.7 and sent < 500 and flow.may_publish("/x"):
            flow.published("/x")
            queue, sent = queue + 1, sent + 1
        elif queue and chance.random() < 0.5:
            queue -= 1
            counter.consumed("/x")
        largest = max(largest, queue)
        if counter.due or chance.random() < 0.1:
            counts = counter.take()
            flow.on_counts("c", list(counts), list(counts.values()))
    counts = counter.take()
    flow.on_counts("c", list(counts), list(counts.values()))
    assert largest <= window
    assert flow.settled
    assert counts == {"/x": 500}


def test_a_consumer_reports_its_topics_from_zero_and_then_in_batches() -> None:
    counter = ConsumedCounter(["/x", "/y"], batch=2)
    assert counter.pending
    assert counter.take() == {"/x": 0, "/y": 0}
    assert not counter.pending
    counter.consumed("/x")
    assert counter.pending
    assert not counter.due
    counter.consumed("/x")
    assert counter.due
    assert counter.take() == {"/x": 2, "/y": 0}

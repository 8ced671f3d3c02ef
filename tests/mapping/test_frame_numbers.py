from __future__ import annotations

from subiaco_mapping.preprocessing.frame_numbers import FrameUnwrapper


def test_numbers_rise_across_the_largest_id() -> None:
    frames = FrameUnwrapper(65536)
    assert [frames.number_of(id_) for id_ in (65534, 65535, 0, 65535, 2)] == [
        65534,
        65535,
        65536,
        65535,
        65538,
    ]


def test_a_frame_long_after_or_before_the_newest_is_of_another_run() -> None:
    frames = FrameUnwrapper(65536)
    assert frames.number_of(1000) == 1000
    assert (frames.number_of(1601), frames.number_of(989)) == (None, None)
    assert (frames.number_of(990), frames.number_of(1600)) == (990, 1600)


def test_a_new_run_begins_with_the_id_of_its_first_frame() -> None:
    frames = FrameUnwrapper(65536)
    frames.number_of(5000)
    assert frames.number_of(3) is None
    assert (frames.restart(3), frames.number_of(4)) == (3, 4)

"""Signals that end a command: never lost in an import, and the handlers of before come back."""

import importlib
import signal

import pytest

from subiaco_geo.signals import signals_interrupt

CATCHES = """
import signal
going_on = False
try:
    signal.raise_signal({number})
    going_on = True
except KeyboardInterrupt:
    pass
"""


@pytest.fixture
def imported(tmp_path, monkeypatch):
    """Return a function that imports a module to which a signal comes and that catches interruptions."""
    monkeypatch.syspath_prepend(tmp_path)

    def load(number):
        name = f"catches_{int(number)}"
        (tmp_path / f"{name}.py").write_text(CATCHES.format(number=int(number)))
        importlib.invalidate_caches()
        return importlib.import_module(name)

    return load


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_an_import_interrupts_after_it(imported, number):
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
    with signals_interrupt() as came:
        assert imported(number).going_on
        with pytest.raises(KeyboardInterrupt):
            signal.sigtimedwait([], 30)
    assert set(came) == {number}
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)] == handlers


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_outside_of_imports_interrupts_at_once(number):
    with signals_interrupt() as came, pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert came == [number]


def test_a_job_inside_of_a_command_leaves_the_signals_to_the_command():
    with signals_interrupt():
        outer = signal.getsignal(signal.SIGTERM)
        with signals_interrupt():
            assert signal.getsignal(signal.SIGTERM) is outer
        assert signal.getsignal(signal.SIGTERM) is outer


def test_a_command_in_the_background_goes_on_ignoring_ctrl_c():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with signals_interrupt() as came:
            signal.raise_signal(signal.SIGINT)
        assert came == []
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)

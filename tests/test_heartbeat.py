"""A call that is watched: it goes on, it stalls, or nobody waits for it any more."""

import threading
import time

import pytest

from pemviz import heartbeat
from pemviz.faults import StopRequested
from pemviz.heartbeat import StalledError, beat, watched


def stop():
    raise StopRequested


def batches():
    return [thread for thread in threading.enumerate() if thread.name == "pemviz-batch"]


def test_what_says_that_it_goes_on_may_take_longer_than_a_step():
    def call():
        for _ in range(5):
            time.sleep(0.2)
            beat()
        return "done"

    assert watched(call, limit_s=0.6) == "done"


def test_what_is_raised_there_is_raised_here():
    with pytest.raises(KeyError, match="wheel"):
        watched(lambda: {}["wheel"], limit_s=9.0)


def test_a_request_to_stop_ends_a_call_at_its_next_step_and_its_thread_with_it():
    steps = []

    def call():
        while True:
            time.sleep(0.05)
            steps.append(0)
            beat()

    with pytest.raises(StopRequested):
        watched(call, limit_s=60.0, pause=lambda: stop() if len(steps) >= 3 else None)
    assert 3 <= len(steps) <= 10
    assert not batches()


def test_a_call_that_stalls_is_left_behind_by_a_request_to_stop(monkeypatch):
    monkeypatch.setattr(heartbeat, "GRACE_S", 0.1)
    released = threading.Event()
    with pytest.raises(StopRequested):
        watched(released.wait, limit_s=3600.0, pause=stop)
    assert len(batches()) == 1
    released.set()
    batches()[0].join(60.0)
    assert not batches()


def test_silence_is_told_once_and_then_ended(monkeypatch):
    monkeypatch.setattr(heartbeat, "SILENT_S", 0.1)
    released, told = threading.Event(), []
    with pytest.raises(StalledError):
        watched(released.wait, limit_s=1.0, on_silence=lambda: told.append(0))
    released.set()
    assert told == [0]
    assert watched(lambda: 7, limit_s=1.0, on_silence=lambda: told.append(0)) == 7
    assert told == [0]

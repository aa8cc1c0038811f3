"""Reading ahead and writing behind: order, errors, bounds, and an end however the block is left."""

# How a block ends is what is tried here:
# ruff: noqa: PT012, PT031

import threading
import warnings

import pytest

from mpfjax.vision.files import threads
from mpfjax.vision.files.threads import read_ahead, write_behind


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = threading.active_count()
    yield
    assert threading.active_count() == before


def test_items_come_in_order_made_by_another_thread_with_its_warnings_and_errors():
    makers = set()

    def items():
        for number in range(50):
            makers.add(threading.current_thread())
            yield number
        warnings.warn("some frames are damaged", RuntimeWarning, stacklevel=1)
        raise ValueError("clip.mp4: cannot be read")

    with pytest.warns(RuntimeWarning, match="damaged"), read_ahead(items()) as ahead:
        assert [next(ahead) for _ in range(50)] == list(range(50))
        with pytest.raises(ValueError, match="cannot be read"):
            next(ahead)
    assert threading.current_thread() not in makers


def test_no_more_is_made_than_there_is_room_for_and_leaving_closes_it():
    made, closed, full = [], threading.Event(), threading.Event()

    def items():
        try:
            for number in range(10**6):
                made.append(number)
                if number == threads._WAITING:
                    full.set()
                yield number
        finally:
            closed.set()

    with pytest.raises(KeyboardInterrupt), read_ahead(items()) as ahead:
        assert next(ahead) == 0
        assert full.wait(60)
        raise KeyboardInterrupt
    assert closed.is_set()
    # Those that wait, the one that was taken, and one in the thread's hands.
    assert len(made) <= threads._WAITING + 2


def test_calls_are_made_in_order_and_all_of_them_also_when_interrupted():
    written, go = [], threading.Event()

    def write_slowly(*two):
        assert go.wait(60)
        written.append((threading.current_thread(), two))

    with pytest.raises(KeyboardInterrupt), write_behind(write_slowly) as write:
        for number in range(3):
            write(number, -number)
        go.set()
        raise KeyboardInterrupt
    assert [two for _, two in written] == [(0, 0), (1, -1), (2, -2)]
    assert threading.current_thread() not in {thread for thread, _ in written}


@pytest.mark.parametrize("calls", [1, 100], ids=["at the end", "by a later call"])
def test_an_error_of_writing_is_raised_and_ends_it(calls):
    tried = []

    def fail(number):
        tried.append(number)
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"), write_behind(fail) as write:
        for number in range(calls):
            write(number)
    assert tried == [0]

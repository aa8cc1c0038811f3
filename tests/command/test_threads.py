"""Reading ahead: order, errors, bounds, and an end however the block is left."""

# How a block ends is what is tried here:
# ruff: noqa: PT012, PT031

import threading
import warnings

import pytest

from mpfjax.vision.files import threads
from mpfjax.vision.files.threads import read_ahead


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

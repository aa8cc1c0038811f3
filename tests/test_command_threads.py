"""Reading ahead and writing behind: order, errors, bounds, and an end however the block is left."""

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


def test_items_come_in_order_made_by_another_thread():
    makers = []

    def items():
        for number in range(50):
            makers.append(threading.current_thread())
            yield number

    with read_ahead(items()) as ahead:
        assert list(ahead) == list(range(50))
    assert threading.current_thread() not in makers


def test_an_error_comes_where_its_item_would_have_come_and_as_it_is():
    def items():
        yield 1
        yield 2
        raise ValueError("clip.mp4: cannot be read")

    with read_ahead(items()) as ahead:
        assert [next(ahead), next(ahead)] == [1, 2]
        with pytest.raises(ValueError, match="cannot be read"):
            next(ahead)


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

    def interrupted():
        with read_ahead(items()) as ahead:
            assert next(ahead) == 0
            assert full.wait(60)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert closed.is_set()
    # Those that wait, the one that was taken, and one in the thread's hands.
    assert len(made) <= threads._WAITING + 2


def test_warnings_of_the_thread_are_seen():
    def items():
        warnings.warn("some frames are damaged", RuntimeWarning, stacklevel=1)
        yield 1

    with pytest.warns(RuntimeWarning, match="damaged"), read_ahead(items()) as ahead:
        assert list(ahead) == [1]


def test_calls_are_made_in_order_and_all_of_them_before_the_block_is_left():
    written = []
    with write_behind(lambda *two: written.append((threading.current_thread(), two))) as write:
        for number in range(50):
            write(number, -number)
    assert [two for _, two in written] == [(number, -number) for number in range(50)]
    assert threading.current_thread() not in {thread for thread, _ in written}


def test_what_was_handed_over_is_written_also_when_interrupted():
    written, go = [], threading.Event()

    def write_slowly(number):
        assert go.wait(60)
        written.append(number)

    def interrupted():
        with write_behind(write_slowly) as write:
            for number in range(3):
                write(number)
            go.set()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert written == [0, 1, 2]


@pytest.mark.parametrize("calls", [1, 100], ids=["at the end", "by a later call"])
def test_an_error_of_writing_is_raised_and_ends_it(calls):
    tried = []

    def fail(number):
        tried.append(number)
        raise OSError("no space left")

    def write_all():
        with write_behind(fail) as write:
            for number in range(calls):
                write(number)

    with pytest.raises(OSError, match="no space left"):
        write_all()
    assert tried == [0]

"""Reading ahead of the tracker and writing behind it, in threads, at the pace of the slowest.

Queues between threads are bounded, so that memory does not grow with the video.
"""

import contextlib
import contextvars
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")
# Enough to even out frames of different cost; a frame of 4K has 25 MB.
_WAITING = 4
# How often a thread that waits looks whether the run has ended, in seconds.
_LOOK = 0.1


class _Made(NamedTuple):
    """An item, or what ended them: an error, or nothing where there are no more."""

    items: tuple[Any, ...] = ()
    error: BaseException | None = None


@contextlib.contextmanager
def read_ahead(items: Iterable[T]) -> Iterator[Iterator[T]]:
    """The items in their order, each made in another thread before it is asked for.

    An exception in making an item is raised in the place of the item. Leaving the block ends the
    thread, which closes the items if they can be closed.
    """
    made: queue.Queue[_Made] = queue.Queue(_WAITING)
    left = threading.Event()

    def hand_over(one: _Made) -> None:
        while not left.is_set():
            with contextlib.suppress(queue.Full):
                return made.put(one, timeout=_LOOK)

    def make() -> None:
        try:
            for item in items:
                hand_over(_Made((item,)))
                if left.is_set():
                    break
            hand_over(_Made())
        except BaseException as error:
            hand_over(_Made(error=error))
        finally:
            close: Callable[[], None] = getattr(items, "close", lambda: None)
            close()

    def taken() -> Iterator[T]:
        while True:
            found = made.get()
            if found.error is not None:
                raise found.error
            if not found.items:
                return
            yield found.items[0]

    thread = _started(make)
    try:
        yield taken()
    finally:
        left.set()
        thread.join()


@contextlib.contextmanager
def write_behind(write: Callable[..., Any]) -> Iterator[Callable[..., None]]:
    """A function that has another thread call `write` with its arguments, one call after the other.

    An exception of `write` is raised by the next call or at the end of the block, and nothing more
    is written. However the block is left, all earlier calls are completed first.
    """
    waiting: queue.Queue[tuple[Any, ...] | None] = queue.Queue(_WAITING)
    errors: list[BaseException] = []

    def work() -> None:
        while (arguments := waiting.get()) is not None:
            try:
                if not errors:
                    write(*arguments)
            except BaseException as error:
                errors.append(error)

    def hand_over(*arguments: Any) -> None:
        if errors:
            raise errors[0]
        waiting.put(arguments)

    thread = _started(work)
    try:
        yield hand_over
    finally:
        waiting.put(None)
        thread.join()
    if errors:
        raise errors[0]


def _started(work: Callable[[], None]) -> threading.Thread:
    """A daemon thread with the settings of this one."""
    thread = threading.Thread(target=contextvars.copy_context().run, args=(work,), daemon=True)
    thread.start()
    return thread

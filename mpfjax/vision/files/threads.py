"""Reading ahead of the tracker and writing behind it, in threads, at the pace of the slowest.

No more than a few frames wait between threads, so that memory does not grow with the video.
"""

import contextlib
import contextvars
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")
# Enough to even out frames of different cost; a frame of 4K has 25 MB.
_WAITING = 4


@contextlib.contextmanager
def read_ahead(items: Iterable[T]) -> Iterator[Iterator[T]]:
    """The items in their order, each made in another thread before it is asked for.

    An exception in making an item is raised in the place of the item. Leaving the block ends the
    thread, which closes the items if they can be closed.
    """
    coming, end = iter(items), object()

    def taken() -> Iterator[Any]:
        while (item := waiting.popleft().result()) is not end:
            waiting.append(start(next, coming, end))
            yield item

    with _one_thread() as start:
        waiting = deque(start(next, coming, end) for _ in range(_WAITING))
        try:
            yield taken()
        finally:
            for future in waiting:
                future.cancel()
            start(getattr(items, "close", lambda: None)).result()


@contextlib.contextmanager
def write_behind(write: Callable[..., Any]) -> Iterator[Callable[..., None]]:
    """A function that has another thread call `write` with its arguments, one call after the other.

    An exception of `write` is raised by the next call or at the end of the block, and nothing more
    is written. However the block is left, all earlier calls are completed first.
    """
    waiting: deque[Future[None]] = deque()
    errors: list[BaseException] = []

    def unless_failed(*arguments: Any) -> None:
        try:
            if not errors:
                write(*arguments)
        except BaseException as error:
            errors.append(error)

    def hand_over(*arguments: Any) -> None:
        if len(waiting) > _WAITING:
            waiting.popleft().result()
        if errors:
            raise errors[0]
        waiting.append(start(unless_failed, *arguments))

    with _one_thread() as start:
        yield hand_over
    if errors:
        raise errors[0]


@contextlib.contextmanager
def _one_thread() -> Iterator[Callable[..., Future[Any]]]:
    """A function that has calls made by one other thread, in turn and with this one's settings."""
    context = contextvars.copy_context()
    with ThreadPoolExecutor(1) as thread:
        yield lambda call, *arguments: thread.submit(context.run, call, *arguments)

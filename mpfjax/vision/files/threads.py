"""Reading ahead of the tracker, and tracking ahead of what writes, at the pace of the slowest.

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
    """The items in their order, each made in one other thread before it is asked for.

    The thread has this one's settings. An exception in making an item is raised in the place of the
    item. Leaving the block ends the thread, which closes the items if they can be closed.
    """
    coming, end, context = iter(items), object(), contextvars.copy_context()

    def start(call: Callable[..., Any], *arguments: Any) -> Future[Any]:
        return thread.submit(context.run, call, *arguments)

    def take() -> Iterator[Any]:
        while (item := waiting.popleft().result()) is not end:
            waiting.append(start(next, coming, end))
            yield item

    with ThreadPoolExecutor(1) as thread:
        waiting = deque(start(next, coming, end) for _ in range(_WAITING))
        try:
            yield take()
        finally:
            for future in waiting:
                future.cancel()
            start(getattr(items, "close", lambda: None)).result()

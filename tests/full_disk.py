"""A disk that is full, as the operating system reports it."""

import contextlib
import resource


@contextlib.contextmanager
def no_room_beyond(num_bytes):
    """Every write that would make a file longer than this fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

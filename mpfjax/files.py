"""Files that an interruption leaves whole."""

import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_whole(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that an interruption or an error leaves the old one or the new one.

    Several threads and processes may write one path. The file is that of the last one to end, and
    it is whole whenever it is read. Raises `OSError` that names the file where there is no room for
    it, or no permission.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Writers that shared a name would write into each other's file, and take it from each other.
    partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}.partial")
    try:
        with open(partial, "xb") as file:
            write(file)
            file.flush()
            # Without it, the file could be empty under its new name after a power cut.
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            fault = f"{error.strerror or error}; nothing that was written before is lost"
            raise OSError(error.errno, fault, str(path)) from error
        raise

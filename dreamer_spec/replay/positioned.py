"""Reading and writing at a place of an open file, also on Windows, which has no calls for it."""

import os
import threading

_position = threading.Lock()


def read_at(fd: int, length: int, offset: int) -> bytes:
    """At most `length` bytes."""
    if hasattr(os, "pread"):
        return os.pread(fd, length, offset)
    with _position:
        os.lseek(fd, offset, os.SEEK_SET)
        return os.read(fd, length)


def write_at(fd: int, data: memoryview, offset: int) -> int:
    """How many bytes were written."""
    if hasattr(os, "pwrite"):
        return os.pwrite(fd, data, offset)
    with _position:
        os.lseek(fd, offset, os.SEEK_SET)
        return os.write(fd, data)


def most_descriptors() -> int:
    """How many files this process may have open."""
    try:
        import resource
    except ModuleNotFoundError:
        return 2048  # of 8192 that Windows allows
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]

"""Disks that are full."""

import contextlib
import resource


@contextlib.contextmanager
def full_disk(after: int):
    """Any file of more than `after` bytes fails as on a full disk, partial write included."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (after, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

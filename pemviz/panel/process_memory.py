"""Memory that departed pages used, given back to the system."""

import contextlib
import ctypes
import gc
import sys

M_ARENA_MAX = -8
ARENAS = 2


def share_arenas() -> None:
    """Have all threads allocate from a few arenas; call it before there are threads.

    glibc gives threads arenas of their own, and each keeps its largest moment.
    """
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # a C library without it
            ctypes.CDLL(None).mallopt(M_ARENA_MAX, ARENAS)


def give_back() -> None:
    """Collect what is unreachable, and have the C library return what it holds in reserve.

    A page's controls refer to one another in cycles, and glibc keeps freed blocks of every
    thread that ever allocated: without this, a server that many browsers have visited keeps
    the memory of its busiest moment.
    """
    gc.collect()
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # a C library without it
            ctypes.CDLL(None).malloc_trim(0)

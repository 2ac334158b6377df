"""Memory that the C library holds though the program has freed it."""

import ctypes
import gc
import sys


def give_back() -> None:
    """Return freed memory to the system, where the C library is GNU's; elsewhere only collect
    garbage.
    """
    gc.collect()
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
    if trim is not None:
        trim(0)

"""Which errors mean that there is not enough memory: libraries do not all raise MemoryError."""

NO_MEMORY = "expected more free memory; close other programs, or use less data, fewer modes or smaller images"
"""The end of the message of such an error."""


def lacks_memory(error: BaseException) -> bool:
    """Return whether an error means that the system gave no memory.

    PyTorch's allocators raise RuntimeErrors. Shared libraries that cannot be mapped raise ImportError, or
    OSError where ctypes opens them.
    """
    if isinstance(error, RuntimeError):
        return any(words in str(error) for words in ("DefaultCPUAllocator", "CUDA out of memory"))
    if isinstance(error, OSError | ImportError):
        if any(words in str(error) for words in ("failed to map segment", "annot allocate memory")):
            return True
        # llvmlite raises another OSError, which names no reason, while it handles this one.
        return error.__context__ is not None and lacks_memory(error.__context__)
    return isinstance(error, MemoryError)

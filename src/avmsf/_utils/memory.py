"""What errors say of memory that is short."""

_UNLOADED = ("failed to map segment", "cannot allocate memory")
"""What the system's loader says, in lower case, of a library that does not fit into the memory."""


def lacks_memory(error: BaseException) -> bool:
    """Return whether an error means that the memory does not suffice.

    Beside MemoryError these are RuntimeError of torch's allocator, ImportError of a module's library, and OSError of a
    library that a module opens by itself, as llvmlite does.
    """
    words = str(error)
    return (
        isinstance(error, MemoryError)
        or (isinstance(error, RuntimeError) and "DefaultCPUAllocator" in words)
        or (isinstance(error, (ImportError, OSError)) and any(each in words.lower() for each in _UNLOADED))
    )

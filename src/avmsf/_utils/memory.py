"""What errors say of memory that is short."""

_UNLOADED = ("failed to map segment", "cannot allocate memory")
"""What the system's loader says, in lower case, of a library that does not fit into the memory."""


def lacks_memory(error: BaseException) -> bool:
    """Return whether an error means that the memory does not suffice.

    Beside MemoryError these are RuntimeError of torch's allocator, ImportError of a module's library, and OSError of a
    library that a module opens by itself, as llvmlite does, whose error has the loader's as its context.
    """
    if isinstance(error, (ImportError, OSError)):
        said = any(words in str(error).lower() for words in _UNLOADED)
        return said or (error.__context__ is not None and lacks_memory(error.__context__))
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "DefaultCPUAllocator" in str(error))

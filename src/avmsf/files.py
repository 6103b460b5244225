"""Files that are either as they were or as they shall be, never in between."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from avmsf.errors import AvmsfError, FieldFileError


def write_whole(path: Path, write: Callable[[Path], object], *, raising: type[AvmsfError] = FieldFileError) -> None:
    """Let `write` fill a temporary file beside `path`, then move it there in one step; missing folders are made.

    What was there stays whole until then: a full disk or a kill leaves the old file, a kill perhaps a hidden
    `.NAME.….part` beside it, which nothing reads. Raises `raising`.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        write(temporary)
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        # mkstemp makes files that only their owner reads; a field is for sharing like any other file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, path)
    except OSError as error:
        raise raising(
            f"{path}: cannot be written ({error.strerror or error}); what was there is untouched: free some space or "
            "choose another place"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)

"""Files that are either as they were or as they shall be, never in between."""

import os
import tempfile
from pathlib import Path

from avmsf.errors import SceneError


def write_whole(path: Path, content: bytes) -> None:
    """Write `content` to a temporary file beside `path`, then move it there in one step; missing folders are made.

    A full disk or a kill leaves what was there before. Raises `SceneError`.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes files that only their owner reads; these are for sharing like any other file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, path)
    except OSError as error:
        raise SceneError(
            f"{path}: cannot be written ({error.strerror or error}); what was there is untouched: free some space or "
            "choose another place"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)

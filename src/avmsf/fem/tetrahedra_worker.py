"""The part of filling a mesh that runs in a process of its own: reads a job, calls pytetwild's compiled core.

Run as a script, with the paths of the job and of the result. Importing pytetwild as a whole needs pyvista (.7 GB),
which serves its front for pyvista's meshes alone, so the core is loaded by its file.
"""

import os
import signal
import sys
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, FileFinder
from importlib.util import module_from_spec
from types import ModuleType

import numpy as np


def main(job_path: str, result_path: str) -> None:
    """Tetrahedralize the job's triangles."""
    with np.load(job_path) as job:
        # Time of the processor, so that what else it does decides nothing; the system ends this process then.
        signal.setitimer(signal.ITIMER_PROF, float(job["seconds"]))
        # The core holds the interpreter's lock: Linux ends this process (SIGIO) as the parent's end closes.
        import fcntl

        fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)
        core = _load_core(str(job["library"]))
        points, cells = core.tetrahedralize_mesh(
            job["points"],
            job["faces"],
            True,  # optimize the tetrahedra's form
            False,  # do not leave out simplifying the triangles first
            float(job["edge"]),  # length of edges over the diagonal of the box around all
            0.0,  # length of edges in meters: none, the one above holds
            float(job["envelope"]),  # how far the surface may move, over that diagonal
            100.0,  # energy at which a tetrahedron's form is good enough; 10 makes a thin wall three times as costly
            False,  # do not coarsen in the end
            1,  # threads
            40,  # rounds of optimizing at most
            6,  # least talkative
            True,  # quiet
            False,  # corners in the ordinary order
            False,  # keep what lies inside alone
            np.empty((0, 3)),
            np.empty((0, 4), dtype=np.int32),
            np.empty(0),
        )
    np.savez(result_path, points=np.asarray(points, dtype=np.float64), cells=np.asarray(cells, dtype=np.int64))


def _load_core(folder: str) -> ModuleType:
    found = FileFinder(folder, (ExtensionFileLoader, EXTENSION_SUFFIXES)).find_spec("PyfTetWildWrapper")
    if found is None or found.loader is None:
        raise ImportError(f"{folder}: expected PyfTetWildWrapper, got none; pip install --force-reinstall pytetwild")
    core = module_from_spec(found)
    found.loader.exec_module(core)
    return core


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])

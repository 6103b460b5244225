"""The part of filling a mesh that runs in a process of its own: reads a job, calls pytetwild's compiled core.

Run as a script, with the paths of the job and of the result. Importing pytetwild as a whole needs pyvista (.7 GB),
which serves its front for pyvista's meshes alone, so the core is loaded by its file.
"""

import ctypes
import sys
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, FileFinder
from importlib.util import module_from_spec
from mmap import PAGESIZE
from pathlib import Path
from types import ModuleType

import numpy as np

_DRAW = "_ZNSt13random_device9_M_getvalEv"
"""The C++ library's function that the core draws the seed of its order of triangles by."""
_SEED = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p)(lambda _: 0)
"""Takes its place; the core calls it, so it lives as long as the process."""


def main(job_path: str, result_path: str) -> None:
    """Tetrahedralize the job's triangles."""
    with np.load(job_path) as job:
        core = _load_core(str(job["library"]))
        if sys.platform == "linux":
            _fix_seed(Path(str(core.__file__)))
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


def _fix_seed(library: Path) -> None:
    """Let the core's seed be 0: it has no argument for it, so the entry of its table of functions is replaced.

    Does nothing where the library has no such entry, or one that cannot be written any more.
    """
    from elftools.elf.elffile import ELFFile
    from elftools.elf.relocation import RelocationSection
    from elftools.elf.sections import SymbolTableSection

    with library.open("rb") as file:
        elf = ELFFile(file)
        names, calls = elf.get_section_by_name(".dynsym"), elf.get_section_by_name(".rela.plt")
        if not isinstance(names, SymbolTableSection) or not isinstance(calls, RelocationSection):
            return
        entries = [
            call["r_offset"] for call in calls.iter_relocations() if names.get_symbol(call["r_info_sym"]).name == _DRAW
        ]
        # Addresses in the file count from here, rounded down to a page, and the library is loaded by whole pages.
        first = min(segment["p_vaddr"] for segment in elf.iter_segments("PT_LOAD")) // PAGESIZE * PAGESIZE
    loaded = [line.split(maxsplit=5) for line in Path("/proc/self/maps").read_text(errors="replace").splitlines()]
    start = min((int(row[0].split("-")[0], 16) for row in loaded if row[-1] == str(library.resolve())), default=None)
    if start is None:
        return
    writable = [[int(end, 16) for end in row[0].split("-")] for row in loaded if row[1].startswith("rw")]
    for entry in entries:
        place = start + entry - first
        if any(low <= place < high for low, high in writable):
            ctypes.c_void_p.from_address(place).value = ctypes.cast(_SEED, ctypes.c_void_p).value


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])

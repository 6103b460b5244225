"""The lowest vibrations of a stiffness and a mass matrix, apart from the motions of a rigid body.

Lanczos' method on the inverse of the stiffness, shifted by a little mass so that a free body has one, with a block of
vectors at a time: solving for sixteen costs a third of solving for each, and of modes that share a frequency, as those
of round things do, none is missed. All of a free body's six rigid motions are known beforehand and are projected out
of every step, so that none is ever found and nothing of them is left in the vibrations. On soft supports the rigid
motions become slow vibrations, which are computed like the others and told apart by their shape: more than half of
their kinetic energy is a rigid motion's.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float64
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from avmsf._utils.compiled import lane_count
from avmsf.errors import SimulationError

_PRECISION = 1e-8
"""Residual of a mode over its eigenvalue at which Lanczos' method stops; eigenvalues are as exact as its square."""
_BLOCK = 16
"""Vectors at a time."""
_MAX_BASIS_RATIO = 6
"""Most vectors altogether, over the number of modes and four blocks; a few modes of a thin ball, close together, take
half as many."""
_RIGID = 6
PENDULUM = 1e-9
"""Squared frequency over the largest, below which a body turns about the place that it is held at: rounding alone."""


def rigid_motions(nodes: Float64[np.ndarray, "nodes 3"], mass: scipy.sparse.csr_array) -> np.ndarray:
    """Return three shifts and three turns of the nodes, mass-normalized and orthogonal, [3 nodes, 6]."""
    total = mass.sum()
    arms = nodes - (mass @ nodes).sum(axis=0) / total
    motions = np.zeros((len(nodes), 3, _RIGID))
    motions[:, [0, 1, 2], [0, 1, 2]] = 1.0
    motions[:, :, 3:] = np.cross(np.eye(3)[:, None], arms).transpose(1, 2, 0)
    flat = motions.reshape(-1, _RIGID)
    # The turns are lengths and the shifts are not, so each is scaled before they are made orthogonal.
    flat /= np.sqrt((flat * times(mass, flat)).sum(axis=0))
    lower = np.linalg.cholesky(flat.T @ times(mass, flat))
    return scipy.linalg.solve_triangular(lower, flat.T, lower=True).T


def lowest_vibrations(
    stiffness: scipy.sparse.sparray,
    mass: scipy.sparse.csr_array,
    rigid: Float64[np.ndarray, "dofs 6"],
    *,
    count: int,
    shift: float,
    supported: bool,
) -> tuple[Float64[np.ndarray, " modes"], Float64[np.ndarray, "dofs modes"]]:
    """Return the `count` lowest vibrations that are no rigid motions: squared angular frequencies, 1/s2, and shapes.

    Shapes are mass-normalized, 1 / sqrt(kg). `mass` is over nodes, `stiffness` over their three components; `shift`,
    1/s2, is far below the lowest squared angular frequency. `supported` bodies are held by springs, others are free.
    Raises SimulationError for no mode, where the body has fewer vibrations, or cells of such bad form that none are
    found.
    """
    if count < 1:
        raise SimulationError.expected("1 mode or more", count, name="count")
    dofs = stiffness.shape[0]
    wanted = count + (_RIGID if supported else 0)
    if wanted + 2 * _RIGID > dofs:
        least, advice = f"{wanted // 3 + 5} or more for {count} modes", "ask for fewer modes or a finer detail"
        raise SimulationError.expected(least, dofs // 3, name="nodes", advice=advice)
    weighted = times(mass, rigid)
    # The factors' blocks are so small that BLAS threads wait for each other: on two busy cores 80 modes of 20,000
    # degrees of freedom took 12 s with two threads and 7 s with one. The limit is the whole process's: what computes
    # bodies in several threads sets it around them all, or it would stay where they end in another order.
    with threadpool_limits(limits=1, user_api="blas"):
        solve = factorize(stiffness, mass, shift=shift)

        def respond(forces: np.ndarray) -> np.ndarray:
            moved = solve(forces)
            return moved if supported else moved - rigid @ (weighted.T @ moved)

        responses, shapes = _largest_responses(respond, mass, wanted)
    squares = 1.0 / responses - shift
    if supported:
        elastic = (((weighted.T @ shapes) ** 2).sum(axis=0) < 0.5) & (squares > PENDULUM * squares[-1])
        squares, shapes = squares[elastic][:count], shapes[:, elastic][:, :count]
    # The largest component of each shape is positive.
    return squares, shapes * np.sign(shapes[np.abs(shapes).argmax(axis=0), np.arange(shapes.shape[1])])


def factorize(
    stiffness: scipy.sparse.sparray, mass: scipy.sparse.csr_array, *, shift: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from forces [dofs, columns] to the motions that stiffness + shift x mass answers with.

    Raises SimulationError where cells have such bad form that there is none.
    """
    heavy = scipy.sparse.kron(mass, scipy.sparse.eye_array(3), format="csc")
    try:
        factored = splu(
            (stiffness + shift * heavy).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
    except RuntimeError as error:
        wanted, advice = "an invertible matrix", "make the tetrahedra with another detail"
        raise SimulationError.expected(wanted, got=str(error), name="stiffness", advice=advice) from error

    def solve(forces: np.ndarray) -> np.ndarray:
        # Two halves side by side, which is the same on any number of processors: it releases the interpreter's lock.
        halves = np.array_split(np.asfortranarray(forces), 2, axis=1)
        with ThreadPoolExecutor(lane_count()) as pool:
            return np.concatenate([*pool.map(factored.solve, halves)], axis=1)

    return solve


def _largest_responses(
    respond: Callable[[np.ndarray], np.ndarray], mass: scipy.sparse.csr_array, wanted: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest eigenvalues of what a body does to the forces mass x motion, and their motions.

    Each step adds the response to the last block of motions, made orthogonal to all before. In the basis that grows so
    the response is a band of blocks, whose eigenvectors end in how far each mode still is from its true shape.
    """
    dofs = 3 * mass.shape[0]
    longest = min(dofs, _MAX_BASIS_RATIO * (wanted + 4 * _BLOCK))
    basis = np.empty((dofs, longest + _BLOCK), order="F")
    band = np.zeros((longest + _BLOCK, longest + _BLOCK))
    drawn = np.random.default_rng(0).standard_normal((dofs, min(_BLOCK, dofs)))
    block, _ = orthonormal(respond(drawn), mass, basis[:, :0])
    begin, end = 0, block.shape[1]
    basis[:, :end] = block
    while True:
        moved = respond(times(mass, basis[:, begin:end]))
        band[:end, begin:end] = basis[:, :end].T @ times(mass, moved)
        block, rest = orthonormal(moved, mass, basis[:, :end])
        size = block.shape[1]
        if end >= wanted or not size:
            values, vectors = np.linalg.eigh(band[:end, :end], UPLO="U")
            chosen = np.argsort(-values, kind="stable")[:wanted]
            residual = np.linalg.norm(rest @ vectors[begin:end, chosen], axis=0)
            if not size or (residual <= _PRECISION * values[chosen]).all():
                return values[chosen], basis[:, :end] @ vectors[:, chosen]
        if end + size > longest + _BLOCK:
            lowest, advice = f"the {wanted} lowest within {end} steps", "make the tetrahedra with another detail"
            raise SimulationError.expected(lowest, end, got="fewer", name="modes", advice=advice)
        basis[:, end : end + size] = block
        begin, end = end, end + size


def orthonormal(
    motions: np.ndarray, mass: scipy.sparse.csr_array, basis: np.ndarray, *, least: float = 1e-12
) -> tuple[np.ndarray, np.ndarray]:
    """Return motions without their part in the basis, mass-normalized and orthogonal, and what makes them of those.

    Directions in which less than `least` of the largest is left are left out.
    """
    scale = np.sqrt((motions * times(mass, motions)).sum(axis=0).max())
    made = np.eye(motions.shape[1])
    # The second time mends what rounding left of the first.
    for _ in range(2):
        motions = motions - basis @ (basis.T @ times(mass, motions))
        squares, turned = np.linalg.eigh(motions.T @ times(mass, motions))
        kept = squares > (least * scale) ** 2
        length = np.sqrt(squares[kept])
        motions = motions @ (turned[:, kept] / length)
        made = (length[:, None] * turned[:, kept].T) @ made
        scale = 1.0
    return motions, made


def times(mass: scipy.sparse.csr_array, vectors: np.ndarray) -> np.ndarray:
    """Return the mass matrix, the same for all three components, times one vector or several."""
    spread = np.ascontiguousarray(vectors).reshape(mass.shape[0], -1)
    return (mass @ spread).reshape(vectors.shape)

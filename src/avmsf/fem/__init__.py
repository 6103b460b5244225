"""Finite elements of an object's body: its elastic modes, and how they sound.

In goes a surface in meters (`mesh.Surface`) or tetrahedra (`Solid`), and a `Material`. Out come `ElasticModes`:
undamped natural frequencies, and mass-normalized shapes on the surface, of which any contact and direction has gains.

Core types: `Solid` (`solid`), `Material` (`material`), `ElasticModes` and their files (`elastic_modes`),
`CandidateBodies`, of which each body is a hypothesis of what lies behind a surface, `Vibration`, damped modes.

- Meshes: `meshing` repairs a surface (generalized cross-validation for noise, quadric decimation), `remeshing` splits
  and collapses edges, `tetrahedra` (`tetrahedra_worker`) fills by fTetWild (Hu et al. 2020), `walls` makes layers
  of prisms along thin walls, where tetrahedra lock; `body_meshes` does so with a wanted number of degrees of freedom.
- Modes: quadratic tetrahedra (`elements`), block Lanczos (`eigen`) beside the motions of a rigid body. `isotropic` has
  them for every isotropic material by a reduced basis (Noor and Peters 1980).
- An object that is partly known: `candidate_bodies` computes bodies by thickness and by where they are held
  (`supports`), `thickness` searches the wall's by evidence, `perturbation` has first-order changes of stiffness and
  mass over Karhunen-Loeve fields, and `updating` finds those that measured gains ask for (Fox and Kapoor 1968).
- Sound: `vibration`, damped (Rayleigh's, or any symmetric matrix) and radiated (simple sources with dipoles).

Start reading with `elastic_modes`, then `candidate_bodies`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Simulated objects whose ground truth is known: struck, recorded and photographed.

In goes an `ObjectRecipe`: a kind of shape or a mesh, a material, a hammer, imperfections, a seed. Out come a
`Simulation`, and with `simulation_folder` a capture folder as a user fills it, with `Truth` (`ground_truth`) beside it:
modes, amplitudes of every recording, true contacts. The same recipe gives the same bytes.

Core types: `ObjectRecipe`, `Imperfections`, `Hammer`, `Shape`, `SoundingBody`, `Simulation`, `Truth`.

- `shapes` makes closed surfaces, tetrahedra and colors by rule: surfaces of revolution, sheets, rods
  swept along a curve and lumps, of prisms that are cut into tetrahedra.
- `bodies` makes the elastic body of a recipe, which stands on soft springs.
- `imperfections` lets walls, stiffness and density vary smoothly over it, damping couple modes, and recordings start
  late or early; each thing has random numbers of its own.
- `strikes` draws contacts that a hammer reaches (rays, farthest points); `hammer` has the force of Hertz's contact or a
  half-sine, and its Laplace transform.
- `simulation` adds up damped modes, each sample at its exact time, and room noise of a 1/f spectrum.

Start reading with `simulation`, then `recipe`, which also lists the object sets.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

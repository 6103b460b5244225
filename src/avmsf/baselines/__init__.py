"""Other systems, rebuilt from their publications, that fields are compared with.

In go the training `Impacts` of an object and its shape; out comes a renderer of sounds at contacts, which
`avmsf.evaluation` scores as it does a field.

- `diffsound`: finite elements, with a material fitted to the recordings. Start with `diffsound.renderer`.
- `sonicgauss`: a neural network on 3D Gaussians, trained by flow matching. Start with `sonicgauss.training`.

Baselines that only repeat or average recordings are in `avmsf.evaluation.simple_methods`. docs/baselines.md says what
was published, and what differs here.
"""

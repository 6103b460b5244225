"""SonicGauss: impact sounds from Gaussians and a contact by flow matching, as published.

- `conditioning`: 23 channels of Gaussians, the encoding of a contact, and their fusion.
- `training`: the objective of rectified flow, its Euler integration, training by it, and the renderer.
- `published`, `point_transformer`: the published architecture, which reads a user's copy of the published weights.
"""

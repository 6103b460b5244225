"""SonicGauss: impact sounds from Gaussians and a contact by flow matching, in its published size and a small one.

- `conditioning`: 23 channels of Gaussians, the encoding of a contact, and their fusion; shared by both sizes.
- `training`: the objective of rectified flow, its Euler integration, training by it, and the renderer of both sizes.
- `published`, `point_transformer`: the published architecture, which reads a user's copy of the published weights.
- `small`: a small generator of log spectrograms.
"""

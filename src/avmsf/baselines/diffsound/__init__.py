"""DiffSound (Jin et al., SIGGRAPH 2024): elastic modes of a material fitted to recordings.

- `body_family`: elastic modes of the bodies that a surface may enclose, for any material and wall thickness.
- `losses`: the Sinkhorn divergence between power spectrograms, and their mean absolute differences.
- `material_fit`: E / rho, Poisson's ratio and the wall thickness, by Adam and by differential evolution.
- `renderer`: gains by mode shapes, with a level or weights by least squares. Start here.
"""

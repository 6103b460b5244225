"""Gains over the surface of an object: a Gaussian process whose kernels are weighed by evidence.

Each mode's gains y at the training contacts are a draw of a Gaussian process, y ~ N(0, s^2 (K_h + (q + floor) I)). A
hypothesis is a kernel K_h and a noise share q; the scale s is integrated out. Kernels come in families, each of which
states one assumption about how gains vary over an object: not at all with the place, smoothly, like a thin plate,
with a symmetry of its shape, with what places look like, or as a mixture of its elastic mode shapes. No hypothesis is
selected. Predictions are means over all of them, weighed by their evidence.
"""

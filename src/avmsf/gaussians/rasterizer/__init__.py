"""Gaussians to images and back: one interface, kernels for processors and for graphics cards."""

"""Finite elements of an object's body."""

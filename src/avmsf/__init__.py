"""The sound of real objects: from a few taps to a field that sounds right wherever the object is struck."""

__version__ = "0.1.0"

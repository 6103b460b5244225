"""The one warning of this floor: the capture can be read, and its owner should know something about it."""

from avmsf.errors import AvmsfWarning


class CaptureWarning(AvmsfWarning):
    """A capture was read, but a recording or a contact in it looks wrong; the message names it and says what to do."""

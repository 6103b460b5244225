"""The one warning of this package: the capture can be read, but something in it looks wrong."""

from avmsf.errors import AvmsfWarning


class CaptureWarning(AvmsfWarning):
    """A capture was read, but a recording or a contact in it looks wrong; the message names it and says what to do."""

"""Recordings with contacts: the folder that a user fills by hand, read, checked, prepared and written."""

from avmsf.capture.audio import read_sound
from avmsf.capture.check import CaptureReport, check
from avmsf.capture.folder import Capture, read_capture, write_capture
from avmsf.capture.impacts import Impacts
from avmsf.capture.measure import RecordingReport
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.surface import Surface, read_surface
from avmsf.capture.warning import CaptureWarning

__all__ = [
    "Capture",
    "CaptureReport",
    "CaptureSettings",
    "CaptureWarning",
    "Impacts",
    "RecordingReport",
    "Surface",
    "check",
    "read_capture",
    "read_sound",
    "read_surface",
    "write_capture",
]

"""The studio: how true and how fast the page sounds, how soon it can be struck, and exports."""

from benchmarks.records import Measurement
from benchmarks.studioexports import exports
from benchmarks.studiopage import page
from benchmarks.studiosound import sound

PARTS: dict[str, Measurement] = {"sound": sound, "page": page, "exports": exports}

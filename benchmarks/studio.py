"""The studio: how true and how fast the page sounds, how soon it can be struck, exports, and pictures."""

from benchmarks.records import Measurement
from benchmarks.studioexports import exports
from benchmarks.studiopage import page, screenshots
from benchmarks.studiosound import sound

PARTS: dict[str, Measurement] = {"sound": sound, "page": page, "exports": exports, "screenshots": screenshots}

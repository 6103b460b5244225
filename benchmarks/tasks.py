"""What a field is for: other materials by physics, and edits towards a sound."""

from benchmarks.changedmaterial import change
from benchmarks.editingprotocol import edit
from benchmarks.records import Measurement

PARTS: dict[str, Measurement] = {"change-material": change, "edit": edit}

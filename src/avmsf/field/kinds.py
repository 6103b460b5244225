"""The gain fields that are fitted to recordings, by what a file calls them."""

from avmsf.field.attention import AttentionGains
from avmsf.field.gainfield import GainField
from avmsf.field.gains.model import MixtureGains

FITTED: dict[str, type[GainField]] = {each.kind: each for each in (AttentionGains, MixtureGains)}
"""Those that hold no other field; `avmsf.field.scaledgains` holds one of them."""

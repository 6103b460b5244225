from .contact_map import ContactMap as ContactMap
from .contact_map import EquivalentPoint as EquivalentPoint
from .contact_map import Peak as Peak

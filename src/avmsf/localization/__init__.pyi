from .contact_map import ContactPosterior as ContactPosterior
from .contact_map import Peak as Peak
from .likelihood import Force as Force
from .locate import locate as locate
from .locate import locate_impacts as locate_impacts
from .locator import Locator as Locator
from .streaming import LocatedImpact as LocatedImpact
from .streaming import StreamingLocalizer as StreamingLocalizer

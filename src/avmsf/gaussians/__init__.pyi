from .cloud import GaussianCloud as GaussianCloud
from .config import SplatConfig as SplatConfig
from .fit import splat as splat
from .ply import read_splats as read_splats
from .ply import write_splats as write_splats

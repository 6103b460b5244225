from .faust import write_faust as write_faust
from .gltf import write_gltf as write_gltf
from .paper_demo import write_demo as write_demo
from .sampled_field import SampledField as SampledField
from .samples import write_grid as write_grid
from .uff import write_universal as write_universal
from .web import make_bundle as make_bundle
from .web import write_webpage as write_webpage

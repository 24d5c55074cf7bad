from . import c_source as c_source
from . import card as card
from . import exporter as exporter
from . import formats as formats
from . import nervous_system as nervous_system
from . import onnx_graph as onnx_graph
from . import stablehlo as stablehlo

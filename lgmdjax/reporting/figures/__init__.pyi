from . import clip_scores as clip_scores
from . import comparison as comparison
from . import detection as detection
from . import learning as learning
from . import locomotion as locomotion
from . import stimulus_scores as stimulus_scores
from . import style as style
from . import trajectories as trajectories

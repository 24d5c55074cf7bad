from . import figures as figures
from . import lgmd_overlay as lgmd_overlay
from . import selection as selection
from . import third_person as third_person
from . import video_io as video_io
from . import walk_video as walk_video

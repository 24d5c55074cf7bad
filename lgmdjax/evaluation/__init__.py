"""The paper's trials and their metrics; looming detectors on stimuli and on video clips."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

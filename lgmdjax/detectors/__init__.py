"""Looming detectors, each with `Params`, `State`, `init` and `step` (`protocol.Detector`).

| module         | detector                                                                   |
| -------------- | -------------------------------------------------------------------------- |
| lgmd           | locust, Blanchard et al. 2000: the one that steers the robot (eqs. 7-16)   |
| lgmd1_grouping | locust, Yue & Rind 2006: grouping layer                                    |
| lgmd1_onoff    | locust, Fu et al. 2018: ON and OFF channels, adaptation                    |
| lgmd2          | locust, Fu et al. 2020: dark objects only                                  |
| d_lgmd         | locust, Zhao et al. 2021: distributed excitation and inhibition            |
| dsn            | locust, Yue & Rind 2007 and 2013: four direction selective networks, fused |
| emd            | Hassenstein & Reichardt 1956: elementary motion detectors                  |
| grm            | Chalupka et al. 2016: generalised regressive motion                        |
| lplc2          | fruit fly, Klapoetke et al. 2017 and Zhou et al. 2022: outward motion      |
| eta, tau       | ideal observers, given the true geometry: Gabbiani et al. 1999, Lee 1976   |
| scaled         | any of them with other cells and gains, for another camera                 |
| alarm          | for any of them: an adaptive scale, a threshold and a minimum duration     |
| cells, on_off  | what several of them share                                                 |
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

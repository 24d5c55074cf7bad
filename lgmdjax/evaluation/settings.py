"""Settings of one trial in stage evaluate."""

from dataclasses import dataclass

from lgmdjax.sensors.settings import CameraSettings


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """A trial (`lgmdjax.evaluation.trials`), the policies that walk it, how often, and for how long."""

    trial: str
    eyes: CameraSettings
    seeds: int
    coarse: CameraSettings | None = None  # of all drivers but the learned one, if it is drawn finer than they
    seconds: float | None = None
    drivers: tuple[str, ...] = ("teacher", "learned", "blind", "direct", "random")

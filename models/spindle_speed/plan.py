"""A planned spindle speed: what the planner hands to whoever commands the speed."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedChoice:
    """The chosen speed, or the programmed one and an alarm."""

    speed_rpm: float
    limiting_depth_mm: float
    """At that speed [mm]; inf where no lobe limits it, NaN where it is not known."""
    pocket_rpm: tuple[float, float]
    """The stable range that holds the chosen speed [1/min]; the same number twice with an alarm."""
    alarm: str | None = None
    """Why no stable speed was found."""
    margin_met: bool = True
    """The demand is met with its margin; without, this is the deepest speed, stable to the depth itself."""

    @property
    def stable(self) -> bool:
        """Whether the demand is met."""
        return self.alarm is None


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedPlan:
    """The speed that the dynamics of now ask for."""

    choice: SpeedChoice
    flagged_span_rpm: float
    """How far it moves over the physical ranges of flagged properties [1/min]; inf where a mode is lost there."""

"""A second look at a chosen speed by semi-discretisation, because pockets of the zeroth order have too steep flanks.

Where teeth cut one after the other, the true boundary leaves that of the zeroth-order solution at the low end of a
pocket by several per cent of the speed. The look costs some ten times the zeroth-order lobes, so it is taken at the
chosen speed alone.
"""

import numpy as np

from models.records import FloatArray
from models.stability.errors import StabilityError
from models.stability.frf_modal_fit import fit_modes
from models.stability.milling import Cut
from models.stability.response import ModalResponse, Mode, SampledResponse, ToolPointResponse
from models.stability.semi_discretisation import default_steps, semi_discretisation, spectral_radius
from models.stability.state_space import state_space

MODE_PAIRS = (6, None)
"""So many are tried first per axis; None: as many as follow the response."""
FEWEST_LINES = 250
"""A response of more lines than twice this is thinned out before the fit."""
LARGEST_RADIUS = 0.985
"""What a tooth leaves halves within 46 tooth passings; slower, the surface shows it and a doubt about the dynamics
turns it into chatter."""


class StabilityVerification:
    """Says whether a speed bears a depth by the spectral radius.

    Parameters
    ----------
    cut
        Engagement and cutting coefficients.
    feeds_deg
        Directions of the feed against X [deg]; all of them must be borne.
    largest_radius
        Spectral radius per tooth passing up to which a cut counts as borne.

    """

    def __init__(self, cut: Cut, feeds_deg: tuple[float, ...] = (0.0,), largest_radius: float = LARGEST_RADIUS) -> None:
        self._cut, self._feeds_deg, self._largest_radius = cut, feeds_deg, largest_radius
        self._fitted: tuple[ToolPointResponse | None, ModalResponse | None] = (None, None)

    def is_stable(self, response: ToolPointResponse, speed_rpm: float, depth_mm: float, tolerance: float) -> bool:
        """Return whether a depth is borne at a speed and at both ends of its tolerance.

        Parameters
        ----------
        response
            The tool point; an axis that acts on the other is not looked at.
        speed_rpm
            The chosen speed [1/min].
        depth_mm
            Axial depth of cut [mm].
        tolerance
            Share of the speed to both sides.

        Returns
        -------
        bool
            Also where no modes follow the response, or vibrations are too many from tooth to tooth: then there is no
            second opinion.

        """
        try:
            modes = self._modes(response)
            return all(
                self._radius(modes, speed_rpm * share, depth_mm, feed_deg) <= self._largest_radius
                for feed_deg in self._feeds_deg
                for share in (1.0 - tolerance, 1.0, 1.0 + tolerance)
            )
        except StabilityError:
            return True

    def _radius(self, modes: ModalResponse, speed_rpm: float, depth_mm: float, feed_deg: float) -> float:
        structure = state_space(modes, feed_deg)
        method = semi_discretisation(structure, self._cut, default_steps(structure, self._cut, speed_rpm))
        return float(spectral_radius(method, speed_rpm, np.array([depth_mm]))[0])

    def _modes(self, response: ToolPointResponse) -> ModalResponse:
        if isinstance(response, ModalResponse):
            return response
        known, modes = self._fitted
        if known is response and modes is not None:
            return modes
        assert isinstance(response, SampledResponse)
        thin = max(len(response.frequency_hz) // FEWEST_LINES, 1)
        frequency_hz, receptance = response.frequency_hz[::thin], response.receptance[::thin]
        axes = [_fitted(frequency_hz, receptance[:, place, place]) for place in (0, 1)]
        found = ModalResponse(xx=axes[0], yy=axes[1])
        self._fitted = (response, found)
        return found


def _fitted(frequency_hz: FloatArray, receptance: np.ndarray) -> tuple[Mode, ...]:
    """Return the modes of one axis, none where it is rigid; raises StabilityError."""
    if not receptance.any():
        return ()
    first, *others = MODE_PAIRS
    try:
        fit = fit_modes(frequency_hz, receptance, pairs=first)
        if not fit.warnings:
            return fit.modes
    except StabilityError:
        pass
    return fit_modes(frequency_hz, receptance, pairs=others[0]).modes

"""Fits parameters of a model to a measured frequency response, and says which of them the data see.

Levenberg and Marquardt's method on ``log(H / H_meas)`` with exact derivatives, or Nelder and Mead's simplex on the
source's cost (4-36). Both vary the logarithms of the parameters, so that no property becomes negative.
A parameter's kind is what its name begins with: kt, ct, kr or cr.
"""


class IdentificationError(ValueError):
    """Data do not allow an identification; the text says why and what to do."""

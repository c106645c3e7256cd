"""Utilities by name, for the command line and studies."""

from __future__ import annotations

from probewise.errors import ParameterError, did_you_mean
from probewise.inquiry.finishing import Finishing
from probewise.inquiry.labels import ParameterValue, WhichShape
from probewise.inquiry.utility import InformationAbout, InformationGain, PerSecond, ReadingEntropy, Utility

UTILITY_NAMES = ("finishing", "information", "entropy", "per-second", "about:PARAMETER", "which-shape")


def utility_named(text: str, *, bin_width: float = 1.0) -> Utility:
    """Build a utility from its name, one of `UTILITY_NAMES`, such as "entropy" or "about:radius_mm".

    "finishing": `Finishing`; "information": `InformationGain`; "entropy": `ReadingEntropy`; "per-second": `PerSecond`
    of the information; "about:PARAMETER": `InformationAbout` that parameter; "which-shape": `InformationAbout` the
    shape.

    Parameters
    ----------
    text
        The name.
    bin_width
        Width of the bins of "entropy", in the unit of readings: the step of the instrument.

    Raises
    ------
    ParameterError
        If no utility has the name, or `bin_width` is not above 0.
    """
    name, _, parameter = text.partition(":")
    if name == "about" and parameter:
        return InformationAbout(ParameterValue(parameter))
    plain: dict[str, Utility] = {
        "finishing": Finishing(),
        "information": InformationGain(),
        "entropy": ReadingEntropy(bin_width),
        "per-second": PerSecond(),
        "which-shape": InformationAbout(WhichShape()),
    }
    if text not in plain:
        raise ParameterError("utility", text, ", ".join(UTILITY_NAMES) + did_you_mean(name, UTILITY_NAMES))
    return plain[text]

"""Faults of the radio link and their rates; parsed from texts such as `late=0.1,3`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Self

from probewise.errors import ParameterError


@dataclass(frozen=True)
class Faults:
    """Rates of faults; by default a link without faults.

    Parameters
    ----------
    fragment
        Probability that a reply comes in pieces, up to 30 ms apart.
    merge
        Probability that a reply is delayed and delivered together with the next one.
    double
        Probability that a reply comes twice, the second time up to 0.1 s later.
    corrupt
        Probability that one byte of a reply, its length included, is changed.
    late, late_s
        Probability that a reply is late, and by how many seconds.
    drop
        Probability, per byte, that a byte of a reply is lost.
    half
        Probability that the end of a telegram is lost, equally likely of a request or of a reply.
    error
        Probability that a request is refused with an error status and not executed.
    silence
        Probability that a request is executed but never answered.
    deaf
        Probability that a request is lost on the way to the brick.
    unasked
        Probability that the brick sends a message of its own before a reply.
    disconnect
        Probability that the link ends when a request arrives; the request is executed and motors run on.
    sag
        Millivolts that the battery loses per minute.
    """

    fragment: float = 0.0
    merge: float = 0.0
    double: float = 0.0
    corrupt: float = 0.0
    late: float = 0.0
    late_s: float = 3.0
    drop: float = 0.0
    half: float = 0.0
    error: float = 0.0
    silence: float = 0.0
    deaf: float = 0.0
    unasked: float = 0.0
    disconnect: float = 0.0
    sag: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in ("late_s", "sag"):
                if not 0 <= value < float("inf"):
                    raise ParameterError(item.name, value, "0 or more")
            elif not 0 <= value <= 1:
                raise ParameterError(item.name, value, "a probability, 0 to 1")

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Self:
        """Parse texts NAME, NAME=RATE or late=RATE,SECONDS, one fault each.

        NAME alone means: every reply fragmented, one byte in 200 dropped, disconnection at one request in 500, a
        battery loss of 60 mV per minute, any other fault at one request in 20.

        Raises
        ------
        ParameterError
            If a name is unknown or its rate is invalid.
        """
        faults = cls()
        for text in texts:
            name, equals, value = text.partition("=")
            if name not in _USUAL:
                raise ParameterError("--fault", text, f"one of {', '.join(_USUAL)}, optionally followed by =RATE")
            names = ("late", "late_s") if name == "late" else (name,)
            try:
                numbers = [float(part) for part in value.split(",")] if equals else [_USUAL[name]]
                faults = replace(faults, **dict(zip(names[: len(numbers)], numbers, strict=True)))
            except ParameterError as error:
                raise ParameterError("--fault", text, f"{error.name} {error.allowed}") from error
            except ValueError as error:
                raise ParameterError("--fault", text, f"{name}=RATE, such as {name}={_USUAL[name]:g}") from error
        return faults


_USUAL = {
    "fragment": 1.0,
    "merge": 0.05,
    "double": 0.05,
    "corrupt": 0.05,
    "late": 0.05,
    "drop": 0.005,
    "half": 0.05,
    "error": 0.05,
    "silence": 0.05,
    "deaf": 0.05,
    "unasked": 0.05,
    "disconnect": 0.002,
    "sag": 60.0,
}

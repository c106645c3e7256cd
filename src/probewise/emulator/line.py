"""A link to the emulated brick within one process, on a virtual clock, without a device."""

from __future__ import annotations

from probewise.emulator.clock import VirtualClock
from probewise.emulator.radio import Radio
from probewise.errors import LinkError


class VirtualLine:
    """A serial line that advances the virtual clock instead of waiting.

    Parameters
    ----------
    radio
        The link to the brick; a new line begins a new connection.
    clock
        The brick's clock.
    """

    name = "the emulator"

    def __init__(self, radio: Radio, clock: VirtualClock) -> None:
        self._radio, self._clock = radio, clock
        self._received = bytearray()
        self._closed = False
        radio.reconnect()

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to `size` bytes, fewer if no more arrive within `timeout_s`.

        Raises
        ------
        LinkError
            If the line is cut.
        """
        deadline_s = self._clock() + timeout_s
        while True:
            self._received += self._radio.receive()
            if len(self._received) >= size or self._clock() >= deadline_s:
                break
            self._require_open()
            next_arrival_s = self._radio.next_arrival_s
            until_s = deadline_s if next_arrival_s is None else min(next_arrival_s, deadline_s)
            self._clock.sleep(max(until_s - self._clock(), 0.0))
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises
        ------
        LinkError
            If the line is cut.
        """
        self._require_open()
        self._radio.send(data)

    def close(self) -> None:
        """Close the line; the state of the brick does not change."""
        self._closed = True

    def _require_open(self) -> None:
        if self._closed or not self._radio.is_open:
            raise LinkError("the line to the emulated brick is cut; open a new one")

"""Manual changes at the bench: the surface on the field, and the sensor's rotation in its mount."""

from __future__ import annotations

import math
from dataclasses import dataclass

from probewise.emulator.scenes import FORMS, parse_scene
from probewise.errors import ParameterError
from probewise.world import Surface


@dataclass
class Tabletop:
    """The surface under the sensor, and the sensor's rotation by hand, relative to the geometry's mounting."""

    surface: Surface
    turned_rad: float = 0.0

    def carry_out_line(self, line: str) -> None:
        """Carry out a typed line: a scene becomes the surface, `turn DEGREES` sets the rotation of the sensor.

        Raises
        ------
        ParameterError
            If the line is neither; nothing changes then.
        """
        verb, _, angle = line.strip().partition(" ")
        try:
            if verb == "turn":
                angle_deg = float(angle)
                if not math.isfinite(angle_deg):
                    raise ValueError(angle)
                self.turned_rad = math.radians(angle_deg)
            else:
                self.surface = parse_scene(line.strip())
        except ValueError as error:
            raise ParameterError("line", line, f"turn DEGREES; {'; '.join(FORMS)}; in mm and degrees") from error

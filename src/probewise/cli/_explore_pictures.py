"""The pictures of `probewise explore`: one per step, the live page, and the final report."""

from __future__ import annotations

import os
import webbrowser
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probewise import experiment as posing
from probewise.cli._explore_inputs import ExploreInputs
from probewise.cli._output import PAGE, Drawings, StagedFiles, staged_output
from probewise.recordings import write_bytes_atomically
from probewise.report import exploration as report
from probewise.report.animation import animated_gif

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from probewise._arrays import FloatArray
    from probewise.experiment import Exploration, Step
    from probewise.progress import Progress

_ANIMATION = "run.gif"


@dataclass
class Pictures:
    """The pictures of a run: draws each step as it arrives, and keeps steps and pictures for the report.

    `files` are the run's input files, which stay where they are when results of an earlier run are removed from `out`.
    """

    out: Path
    inputs: ExploreInputs
    live: bool
    truth_mm: FloatArray | None
    files: Sequence[Path] = ()
    steps: list[Step] = field(default_factory=list)
    shadows: list[Step] = field(default_factory=list)
    """Steps of the other sensor model on the same readings."""
    frames: list[bytes] = field(default_factory=list)
    """PNG of each step; b"" where it could not be drawn."""

    def __post_init__(self) -> None:
        self.drawings = Drawings(self.out)

    def draw_and_write(self, step: Step, shadow: Step | None) -> None:
        """Draw a step, with the other sensor model's (`shadow`), if any; write a PNG and, if `live`, the page."""
        self.steps.append(step)
        if shadow is not None:
            self.shadows.append(shadow)
        name = f"{step.number:03d}.png"
        self.frames.append(self.drawings.draw(f"frames/{name}", partial(self._draw_frame, step, shadow)))
        if step.number == 1 and not step.replayed:
            _remove_earlier_results(self.out, self.files)
        folder = self.out / "frames"
        folder.mkdir(exist_ok=True)
        if self.frames[-1]:
            write_bytes_atomically(folder / name, self.frames[-1])
        if self.live and (page := self.drawings.draw("live.html", partial(self._live_page, step))):
            write_bytes_atomically(self.out / "live.html", page)
            if len(self.frames) == 1:
                webbrowser.open((self.out / "live.html").absolute().as_uri())

    def _live_page(self, step: Step) -> bytes:
        trust = self.inputs.experiment.trust
        return report.live_page_html(step, self.frames[-1], earlier=self.steps[:-1], trust=trust).encode(
            "utf-8", "backslashreplace"
        )

    def _draw_frame(self, step: Step, shadow: Step | None) -> bytes:
        inputs = self.inputs
        poses = [(each.reading.pose, each.reading.value) for each in self.steps]
        readings = [(pose.x_mm, pose.y_mm, value) for pose, value in poses]
        if shadow is None or inputs.other is None:
            return report.robot_view_png(
                step, inputs.experiment, readings, levels=inputs.black_and_white_readings, truth_mm=self.truth_mm
            )
        views = {inputs.model: (step, inputs.experiment), inputs.other_model: (shadow, inputs.other)}
        titled = [("naive model", *views["naive"]), ("SSF model", *views["ssf"])]
        return report.robot_views_by_model_png(
            titled, readings, levels=inputs.black_and_white_readings, truth_mm=self.truth_mm
        )

    def write_results(
        self, result: Exploration, *, seed: int, known: Mapping[str, float] | None, progress: Progress
    ) -> StagedFiles:
        """Write result.json, posterior samples and sensor.json, then animation and report; return the former.

        The sensor is the one that the run was given, with the effect that the run found in it, if any; what a run with
        --learn-sensor learnt of SSF and levels is not in it.
        """
        with staged_output(self.out, inputs=self.files, outdated=(_ANIMATION, PAGE)) as stage:
            stage.write("result.json", posing.result_json(result))
            stage.write("samples.csv", posing.samples_csv(result))
            learnt = posing.repaired_sensor(self.inputs.sensor, result.last, rng=np.random.default_rng(seed))
            stage.write("sensor.json", learnt.to_json())
        beside: dict[str, list[Step]] | None = {self.inputs.other_model: self.shadows} if self.shadows else None
        self.drawings.write_report(
            {_ANIMATION: lambda: animated_gif([frame for frame in self.frames if frame])},
            lambda _: report.page_html(
                result,
                self.frames,
                seed=seed,
                model=self.inputs.model,
                truth=known,
                beside=beside,
                unit=self.inputs.sensor.instrumentation.unit,
            ),
            inputs=self.files,
            progress=progress,
        )
        return stage


def _remove_earlier_results(out: Path, files: Sequence[Path]) -> None:
    """Remove the results of an earlier run from `out`, but none of `files`, so that two runs do not mix."""
    # Without a result.json, a sensor.json is none of these results, but perhaps somebody's calibration.
    of_machine = ("result.json", "samples.csv", "sensor.json") if (out / "result.json").exists() else ()
    spared = {os.path.realpath(path) for path in files}
    for pattern in ("report.html", "run.gif", "live.html", "frames/[0-9]*.png", *of_machine):
        for path in out.glob(pattern):
            if os.path.realpath(path) not in spared:
                path.unlink()

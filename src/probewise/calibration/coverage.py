"""Validate calibration against known truth: coverage of the 95 % intervals, and the order found by evidence.

Recordings of the paper's plan are simulated by the independent pixel world, each with a random
single-Gaussian SSF; calibration gets only the readings.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from probewise._arrays import FloatArray
from probewise._version import __version__
from probewise.calibration.fields import mixture_moments
from probewise.calibration.fit import calibrate
from probewise.errors import ParameterError
from probewise.recordings import Recording, paper_plan, write_text_atomically
from probewise.world import Blob, World, gaussian_spot

__all__ = [
    "Coverage",
    "TrueSensor",
    "draw_true_sensor",
    "interval_holds_truth_by_quantity",
    "simulate_coverage",
    "simulate_log_z_lead_of_one_gaussian",
    "simulate_paper_recording",
]

_MASS = 0.95


@dataclass(frozen=True)
class TrueSensor:
    """A simulated sensor: one Gaussian (centre, sds in mm, correlation), readings over black and white, noise sd."""

    center_mm: tuple[float, float]
    sd_mm: tuple[float, float]
    correlation: float
    black: float
    white: float
    noise_sd: float


@dataclass(frozen=True)
class Coverage:
    """How often the 95 % interval of each quantity contained the truth, in `n_recordings` recordings.

    `held`: the count by quantity. `n_live`: live points of each fit.
    """

    n_recordings: int
    held: dict[str, int]
    n_live: int

    def to_json(self, **about: object) -> str:
        """Return the counts with their Wilson intervals as JSON text; `about` is added, such as the command."""
        rows = {}
        for name, k in self.held.items():
            within = binomtest(k, self.n_recordings).proportion_ci(method="wilson")
            rows[name] = {"held": k, "of": self.n_recordings, "wilson95": [float(within.low), float(within.high)]}
        total = sum(self.held.values())
        share = {"held": total, "of": self.n_recordings * len(self.held)}
        document = {"mass": _MASS, "n_live": self.n_live, "version": __version__, "all": share, "intervals": rows}
        return json.dumps({**about, **document}, indent=1, allow_nan=False) + "\n"

    def save(self, path: str | os.PathLike[str], **about: object) -> None:
        """Write `to_json` to a file, atomically."""
        write_text_atomically(path, self.to_json(**about))


def draw_true_sensor(*, rng: np.random.Generator) -> TrueSensor:
    """Draw a sensor like the paper's: offset by a few mm, anisotropic, with I_max - I_min of 45 to 55 units."""
    black = float(rng.uniform(8, 12))
    return TrueSensor(
        center_mm=(float(rng.uniform(-3, 3)), float(rng.uniform(-3, 3))),
        sd_mm=(float(rng.uniform(2.5, 7)), float(rng.uniform(2.5, 7))),
        correlation=float(rng.uniform(-0.5, 0.5)),
        black=black,
        white=black + float(rng.uniform(45, 55)),
        noise_sd=float(rng.uniform(0.3, 0.8)),
    )


def simulate_paper_recording(truth: TrueSensor, *, rng: np.random.Generator) -> Recording:
    """Simulate the paper's plan with this sensor in the pixel world."""
    spot = gaussian_spot([Blob(1.0, truth.center_mm, truth.sd_mm, truth.correlation)])
    world = World(spot, black=truth.black, white=truth.white, noise_sd=truth.noise_sd)
    return world.simulate(paper_plan(), rng=rng)


def simulate_coverage(
    n_recordings: int,
    *,
    rng: np.random.Generator,
    n_live: int = 300,
    quick: bool = False,
    executor: Executor | None = None,
    progress: Callable[[Coverage], None] | None = None,
) -> Coverage:
    """Calibrate one Gaussian on many simulated recordings and count the intervals that hold the truth.

    Parameters
    ----------
    n_recordings
        Number of recordings, 1 or more; else ParameterError.
    rng
        Source of randomness for truths, noise and fits; spawned for each recording.
    n_live
        Live points of each fit.
    quick
        Whether to calibrate the quick way; see `calibrate`.
    executor
        Runs the fits; by default they run here, one by one. The counts do not depend on it.
    progress
        Called after each recording with the counts so far.
    """
    if n_recordings < 1:
        raise ParameterError("n_recordings", n_recordings, "1 or more")
    held: dict[str, int] = {}
    each = map if executor is None else executor.map
    for k, one in enumerate(
        each(_simulate_and_check_intervals, rng.spawn(n_recordings), [n_live] * n_recordings, [quick] * n_recordings)
    ):
        held = {name: held.get(name, 0) + int(inside) for name, inside in one.items()}
        if progress is not None:
            progress(Coverage(k + 1, held, n_live))
    return Coverage(n_recordings, held, n_live)


def _simulate_and_check_intervals(rng: np.random.Generator, n_live: int, quick: bool) -> dict[str, bool]:
    """Simulate and calibrate one recording; return for each quantity whether its interval holds the truth."""
    truth = draw_true_sensor(rng=rng)
    recording = simulate_paper_recording(truth, rng=rng)
    return interval_holds_truth_by_quantity(
        truth, calibrate(recording, orders=(1,), n_live=n_live, quick=quick, rng=rng).sensor.samples
    )


def interval_holds_truth_by_quantity(truth: TrueSensor, samples: FloatArray) -> dict[str, bool]:
    """Return by quantity whether the 95 % interval of samples of one Gaussian, (n, 8), holds the truth."""
    found = {**mixture_moments(samples, 1), "I_min": samples[:, -2], "I_max": samples[:, -1]}
    held = {}
    for name, value in _true_quantities(truth).items():
        low, high = _central_interval(found[name])
        held[name] = bool(low <= value <= high)
    return held


def simulate_log_z_lead_of_one_gaussian(
    truth: TrueSensor, *, rng: np.random.Generator, n_live: int = 300, quick: bool = False
) -> tuple[float, float]:
    """Simulate a recording of `truth`; return log Z of one Gaussian minus that of two, and its error."""
    recording = simulate_paper_recording(truth, rng=rng)
    one, two = calibrate(recording, orders=(1, 2), n_live=n_live, quick=quick, rng=rng).orders
    return one.log_z - two.log_z, math.hypot(one.log_z_error, two.log_z_error)


def _simulate_log_z_lead_for_drawn_truth(rng: np.random.Generator, n_live: int, quick: bool) -> tuple[float, float]:
    return simulate_log_z_lead_of_one_gaussian(draw_true_sensor(rng=rng), rng=rng, n_live=n_live, quick=quick)


def main() -> None:
    """Run one of the two campaigns and write its JSON file; see `python -m probewise.calibration.coverage --help`."""
    parser = argparse.ArgumentParser(prog="python -m probewise.calibration.coverage", description=__doc__)
    parser.add_argument(
        "campaign",
        choices=("coverage", "order"),
        help="intervals of N = 1 that hold the truth, or evidence of N = 1 over 2",
    )
    parser.add_argument("--recordings", type=int, required=True, help="how many recordings are simulated")
    parser.add_argument("--live", type=int, default=300, help="live points (default 300)")
    parser.add_argument("--quick", action="store_true", help="calibrate the quick way")
    parser.add_argument("--seed", type=int, default=20, help="seed (default 20)")
    parser.add_argument("--workers", type=int, default=2, help="processes; they change no result (default 2)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON file to write")
    asked = parser.parse_args()
    about = {
        "command": f"{parser.prog} {asked.campaign} --recordings {asked.recordings} --live {asked.live} "
        f"{'--quick ' if asked.quick else ''}--seed {asked.seed} --out {asked.out.name}",
        "seed": asked.seed,
        "date": datetime.date.today().isoformat(),
    }
    rng = np.random.default_rng(asked.seed)
    with (
        ProcessPoolExecutor(asked.workers, mp_context=multiprocessing.get_context("spawn")) as executor,
        tqdm(total=asked.recordings, desc=asked.campaign) as bar,
    ):
        if asked.campaign == "coverage":

            def advance_bar(_: Coverage) -> None:
                bar.update()

            counts = simulate_coverage(
                asked.recordings, rng=rng, n_live=asked.live, quick=asked.quick, executor=executor, progress=advance_bar
            )
            counts.save(asked.out, **about)
            return
        leads = []
        each = rng.spawn(asked.recordings), [asked.live] * asked.recordings, [asked.quick] * asked.recordings
        for lead, error in executor.map(_simulate_log_z_lead_for_drawn_truth, *each):
            leads.append((round(lead, 3), round(error, 3)))
            bar.update()
    preferred = sum(lead > 0 for lead, _ in leads)
    rows = {
        "n_live": asked.live,
        "version": __version__,
        "prefer_one": preferred,
        "of": len(leads),
        "leads_nats": leads,
    }
    write_text_atomically(asked.out, json.dumps({**about, **rows}, indent=1) + "\n")


def _true_quantities(truth: TrueSensor) -> dict[str, float]:
    """Return a sensor's moments and levels by quantity, named as by `mixture_moments`, and "I_min" and "I_max"."""
    return {
        "centre x'": truth.center_mm[0],
        "centre y'": truth.center_mm[1],
        "log width along x'": math.log(truth.sd_mm[0]),
        "log width along y'": math.log(truth.sd_mm[1]),
        "correlation of x' and y'": truth.correlation,
        "I_min": truth.black,
        "I_max": truth.white,
    }


def _central_interval(samples: FloatArray) -> tuple[float, float]:
    low, high = np.quantile(samples, [0.5 - _MASS / 2, 0.5 + _MASS / 2])
    return float(low), float(high)


if __name__ == "__main__":
    main()

"""Hold `calibrate(quick=True)` against itself over seeds, and against nested sampling of every order.

python benchmarks/quick_calibration.py --seeds 12 --sensors 2 --seed 28 --out quick_calibration.json

`--seeds` quick calibrations of the shipped paper recording, or of `--recording`, tell whether the stated errors cover
the scatter: chi-square a run, about the log of the mean evidence. `--sensors` concealed sensors of one Gaussian, and
as many of two, are calibrated both ways: differences in units of both errors, the chosen orders, cpu seconds, and how
many 95 % intervals of the sensors of one Gaussian hold the truth. A run that was stopped resumes from `--out`.

`--reference` runs of nested sampling with `--live` live points of each order, of the same recording, are what the
evidences are held against; runs that are there already are kept.
"""

from __future__ import annotations

import argparse
import datetime
import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from probewise import __version__
from probewise.calibration import Calibration, calibrate, default_prior, mixture_moments
from probewise.calibration.paper import ProblemsByOrder, search_prior_of_order
from probewise.errors import DoubtfulResultWarning
from probewise.recordings import Recording, paper_plan, read_recording, shipped, two_way_plan, write_text_atomically
from probewise.world import Blob, World, gaussian_spot


@dataclass(frozen=True)
class TrueSensor:
    """A simulated sensor: one Gaussian (centre, sds in mm, correlation), readings over black and white, noise sd."""

    center_mm: tuple[float, float]
    sd_mm: tuple[float, float]
    correlation: float
    black: float
    white: float
    noise_sd: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> TrueSensor:
        """Draw a sensor like the paper's: offset by a few mm, anisotropic, with I_max - I_min of 45 to 55 units."""
        black, centre, sd = rng.uniform(8, 12), tuple(rng.uniform(-3, 3, 2)), tuple(rng.uniform(2.5, 7, 2))
        correlation, span = rng.uniform(-0.5, 0.5), rng.uniform(45, 55)
        return cls(centre, sd, correlation, black, black + span, rng.uniform(0.3, 0.8))

    def record(self, rng: np.random.Generator) -> Recording:
        """Simulate the paper's plan with this sensor in the pixel world."""
        spot = gaussian_spot([Blob(1.0, self.center_mm, self.sd_mm, self.correlation)])
        world = World(spot, black=self.black, white=self.white, noise_sd=self.noise_sd)
        return world.simulate(paper_plan(), rng=rng)

    def held(self, samples: np.ndarray) -> dict[str, bool]:
        """Return by quantity whether the 95 % interval of samples of one Gaussian, (n, 8), holds the truth."""
        found = {**mixture_moments(samples, 1), "I_min": samples[:, -2], "I_max": samples[:, -1]}
        truth = (*self.center_mm, *np.log(self.sd_mm), self.correlation, self.black, self.white)
        ends = np.quantile(list(found.values()), [0.025, 0.975], axis=1)
        return dict(zip(found, ((ends[0] <= truth) & (truth <= ends[1])).tolist(), strict=True))


def timed(
    recording: Recording,
    rng: np.random.Generator,
    *,
    quick: bool,
    orders: tuple[int, ...] = (1, 2, 3, 4),
    truth: TrueSensor | None = None,
) -> dict[str, object]:
    """Calibrate; keep evidences, errors, evaluations, cpu seconds and, by the truth, which intervals hold it."""
    began = time.process_time()
    found: Calibration = calibrate(recording, orders=orders, quick=quick, rng=rng)
    cpu_s = round(time.process_time() - began, 1)
    held = {} if truth is None else {"held": truth.held(found.fits[0].sensor.samples)}
    return {
        "cpu_s": cpu_s,
        "log_z": [round(o.log_z, 3) for o in found.orders],
        "log_z_error": [round(o.log_z_error, 3) for o in found.orders],
        "n_calls": [fit.result.n_calls for fit in found.fits],
        "chosen": found.chosen.n_gaussians,
        "notes": sorted({note for fit in found.fits for note in fit.sensor.notes}),
        **held,
    }


def two_lobes(rng: np.random.Generator) -> Recording:
    """Record with a sensor of two Gaussians, 4 to 12 mm apart."""
    half, angle = rng.uniform(2, 6), rng.uniform(0, np.pi)
    u, v = half * np.cos(angle), half * np.sin(angle)
    spot = gaussian_spot([Blob(0.5, (u, v), (2.5, 3.0)), Blob(0.5, (-u, -v), (2.5, 3.0))])
    return World(spot, noise_sd=0.4).simulate(paper_plan(), rng=rng)


def reference_runs(
    recording: Recording, orders: tuple[int, ...], *, n_runs: int, n_live: int, seed: int, out: Path
) -> None:
    """Search each order so many times, order after order, and write every run."""
    problems = ProblemsByOrder(recording, default_prior)
    streams = {n: np.random.default_rng([seed, n]).spawn(n_runs) for n in orders}
    document: dict[str, object] = {"n_live": n_live, "seed": seed, "date": datetime.date.today().isoformat()}
    rows: list[dict[str, object]] = json.loads(out.read_text())["runs"] if out.exists() else []
    done = {(row["run"], row["order"]) for row in rows}
    for run, n in tqdm([(run, n) for run in range(n_runs) for n in orders if (run, n) not in done], desc="reference"):
        began = time.process_time()
        found = search_prior_of_order(problems, n, streams[n][run], n_live=n_live)
        result, refined = found.result, found.refined
        row: dict[str, object] = {"run": run, "order": n, "log_z": result.log_z, "log_z_error": result.log_z_error}
        if refined is not None:
            row |= {"refined": refined.log_z, "refined_error": refined.log_z_error, "sound": refined.sound}
        rows.append({**row, "cpu_s": round(time.process_time() - began, 1)})
        document["runs"] = rows
        write_text_atomically(out, json.dumps(document, indent=1) + "\n")


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--sensors", type=int, default=2)
    parser.add_argument("--orders", type=int, nargs="+", default=[1, 2, 3, 4], help="of the sensors")
    parser.add_argument("--seed", type=int, default=28)
    parser.add_argument("--reference", type=int, default=0, help="runs of nested sampling, and nothing else")
    parser.add_argument("--live", type=int, default=3000, help="live points of these")
    parser.add_argument("--recording", type=Path, help="CSV file in place of the shipped one")
    parser.add_argument("--two-way", action="store_true", help="961 simulated readings in place of the shipped ones")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    warnings.simplefilter("ignore", DoubtfulResultWarning)
    rng = np.random.default_rng(asked.seed)
    paper = read_recording(asked.recording or shipped("paper"))
    if asked.two_way:
        spot = gaussian_spot([Blob(1.0, (0.5, 1.5), (4.0, 2.5), 0.1)])
        paper = World(spot, noise_sd=0.5).simulate(two_way_plan(), rng=rng)
    orders = tuple(asked.orders)
    if asked.reference:
        reference_runs(paper, orders, n_runs=asked.reference, n_live=asked.live, seed=asked.seed, out=asked.out)
        return
    document: dict[str, object] = {
        "command": f"benchmarks/quick_calibration.py --seeds {asked.seeds} --sensors {asked.sensors} "
        f"--orders {' '.join(map(str, orders))} --seed {asked.seed}"
        + (f" --recording {asked.recording.name}" if asked.recording else "")
        + (" --two-way" if asked.two_way else ""),
        "n_readings": len(paper),
        "date": datetime.date.today().isoformat(),
        "version": __version__,
    }

    def save() -> None:
        write_text_atomically(asked.out, json.dumps(document, indent=1) + "\n")

    before = json.loads(asked.out.read_text()) if asked.out.exists() else {}
    if before.get("command") != document["command"]:
        before = {}
    runs: list[dict[str, object]] = before.get("paper", {}).get("runs", [])
    for stream in tqdm(rng.spawn(asked.seeds)[len(runs) :], desc="seeds"):
        runs.append(timed(paper, stream, quick=True))
        document["paper"] = {"runs": runs, **scatter(runs)}
        save()
    pairs: list[dict[str, object]] = before.get("sensors", [])
    if runs:
        document["paper"] = {"runs": runs, **scatter(runs)}
    done = {pair["sensor"] for pair in pairs}
    left = [(k, stream) for k, stream in enumerate(rng.spawn(asked.sensors)) if k not in done]
    for k, stream in tqdm(left, desc="sensors"):
        truth = TrueSensor.drawn(stream)
        for recording, known in ((truth.record(stream), truth), (two_lobes(stream), None)):
            quick, full = (timed(recording, stream, quick=way, orders=orders, truth=known) for way in (True, False))
            apart = np.subtract(quick["log_z"], full["log_z"])  # type: ignore[arg-type]
            error = np.hypot(quick["log_z_error"], full["log_z_error"])  # type: ignore[call-overload]
            pairs.append(
                {
                    "sensor": k,
                    "gaussians": "two" if known is None else "one",
                    "quick": quick,
                    "full": full,
                    "z": np.round(apart / error, 2).tolist(),
                }
            )
        document["sensors"] = pairs
        save()


def scatter(runs: list[dict[str, object]]) -> dict[str, list[float]]:
    """Tell how the runs scatter beside their errors, by order."""
    log_z, error = (np.array([run[key] for run in runs], dtype=float) for key in ("log_z", "log_z_error"))
    mean = np.log(np.mean(np.exp(log_z - log_z.max()), axis=0)) + log_z.max()
    spread = log_z.std(axis=0, ddof=1) if len(runs) > 1 else np.zeros(log_z.shape[1])
    return {
        "log_mean_z": np.round(mean, 3).tolist(),
        "sd": np.round(spread, 3).tolist(),
        "rms_error": np.round(np.sqrt((error**2).mean(axis=0)), 3).tolist(),
        "chi2_a_run": np.round((((log_z - mean) / error) ** 2).mean(axis=0), 2).tolist(),
    }


if __name__ == "__main__":
    main()

"""The paper's robot: a nested sampling run after every reading, fifty samples, entropy of their predictions.

Paper, section 2.3, "The Machine Learning System", eq. 5: `find_shape` is the loop; `explore --method paper` takes the
same steps through `method.NestedSampling`. The sensor model is given: for `explore`, the mean of the sampled SSFs
merged into 32 Gaussians (`from_sensor`). Unlike the paper: sigma has proper bounds, and half of the live points are
replaced at a time; the sds that end a run are those of all weighted samples (more in docs/explanation/errata.md).
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm import Instrument, Pose, Reading
from probewise.arm.carry_out import PATTERN, recording_of
from probewise.errors import require
from probewise.inference.likelihoods import StudentT
from probewise.inference.problem import Likelihood, SensorProblem
from probewise.inquiry import Grid, choose, entropy_map
from probewise.nested import EvidenceChange, KernelMove, NestedResult, diversify, run
from probewise.scene import AnyOf, Shape
from probewise.sensor import FixedLevels
from probewise.sensor.stages import SensorModel

N_LIVE = 300
N_SAMPLES = 50
N_STEPS = 1000
_LEAST_SHARE = 1e-3  # of the levels' difference: least noise sd


def find_shape(
    arm: Instrument,
    shape: Shape,
    model: SensorModel,
    likelihood: Likelihood,
    grid: Grid,
    *,
    bin_width: float,
    stop_sd_mm: float = 4.0,
    rng: np.random.Generator,
) -> Generator[tuple[tuple[Reading, ...], NestedResult, FloatArray], None, None]:
    """Let the arm find a shape (paper, section 2.3): measure, infer, inquire.

    Parameters
    ----------
    arm
        The instrument, already entered.
    shape, model, likelihood
        The possible shape with its prior (no set of shapes), the sensor over it, and the likelihood of readings given
        predictions.
    grid
        Possible places of readings.
    bin_width
        Width of the bins in which predicted readings are counted, in the reading's unit: its rounding step.
    stop_sd_mm
        Posterior sd below which every parameter in mm has to be.
    rng
        Source of randomness.

    Yields
    ------
    The readings so far, the posterior given them, and fifty shapes drawn from it, (50, n_params).
    """
    require(not isinstance(shape, AnyOf), "shape", shape, "one shape; explore takes sets")
    places_mm, plan = grid.places_mm, grid.plan(PATTERN)
    reachable, orientation_rad = arm.reachable(places_mm), arm.orientation_rad(places_mm)
    plan = replace(plan, orientation_rad=orientation_rad)
    lengths = [k for k, name in enumerate(shape.prior.names) if name.endswith("_mm")]
    readings: tuple[Reading, ...] = ()
    shapes = shape.prior.from_unit_cube(rng.random((N_SAMPLES, len(shape.prior.names))))
    target_reached = False
    while not target_reached:
        entropy = entropy_map(model, shapes, grid, plan, reachable=reachable, bin_width=bin_width)
        place = choose(entropy.values, reachable, rng=rng)
        x_mm, y_mm = places_mm[place].tolist()
        readings = (*readings, arm.measure(Pose(x_mm, y_mm, float(orientation_rad[place]))))
        problem = SensorProblem(shape.prior, model, likelihood, recording_of(readings))
        posterior = run(problem, n_live=N_LIVE, stop=EvidenceChange(), move=KernelMove(), max_cost=1.0, rng=rng)
        shapes = diversify(posterior.samples(N_SAMPLES, rng=rng), problem, n_steps=N_STEPS, rng=rng)
        yield readings, posterior, shapes
        target_reached = bool((posterior.sd()[lengths] < stop_sd_mm).all())


@dataclass(frozen=True)
class OneScan:
    """Student-t likelihood of any number of readings that share one unknown noise sd (paper, eq. 11).

    `sd_floor` and `sd_ceiling` bound the sd, in the sensor's unit; its prior is 1/sigma between them.
    """

    sd_floor: float
    sd_ceiling: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood, (n_samples,), of readings (n_points,) given predictions (n_samples, n_points)."""
        one = np.zeros(readings.size, dtype=np.int64)
        return StudentT(one, self.sd_floor, self.sd_ceiling).log_prob(readings, predicted)


def student_t_likelihood(levels: FixedLevels, step: float | None) -> OneScan:
    """Return the Student-t likelihood with its noise sd bounded for these levels.

    The sd is at least `least_sd`, at most the levels' difference, or ten times the least sd if that is larger.
    """
    span = abs(levels.i_max - levels.i_min)
    floor = least_sd(span, step)
    return OneScan(floor, max(span, 10.0 * floor))


def least_sd(span: float, step: float | None) -> float:
    """Return the least plausible sd: that of rounding to `step` or a thousandth of `span`, whichever is larger."""
    return max((step or 0.0) / math.sqrt(12.0), _LEAST_SHARE * span)

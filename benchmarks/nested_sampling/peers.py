"""The peers, each by one small function at its documented settings; needs the `bench` extra.

All are given the same problem. Those that evaluate in batches get batches. `n_live` None leaves each its own default.
"""

from __future__ import annotations

import logging
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from nested_sampling.sampler import Counted, Outcome, Sampler

_REMAINING = 0.01  # nats: the remaining evidence at which the peers that are told stop; their usual choice


def _logs(weights: Any) -> Any:
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


def dynesty(problem: Counted, seed: int, n_live: int | None, sample: str = "auto") -> Outcome:
    """Run dynesty with its bounding ellipsoids and, by default, the move that it picks for the dimension."""
    n_live = n_live or 500
    sampler = import_module("dynesty").NestedSampler(
        problem.single,
        problem.from_unit,
        problem.n_params,
        nlive=n_live,
        sample=sample,
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(dlogz=_REMAINING, print_progress=False)
    found = sampler.results
    return Outcome(
        float(found.logz[-1]),
        float(found.logzerr[-1]),
        problem.n_evaluations,
        np.asarray(found.samples),
        np.asarray(found.logwt),
        n_live,
    )


def ultranest(problem: Counted, seed: int, n_live: int | None, population: bool = False) -> Outcome:
    """Run ultranest as it comes, by regions (MLFriends), or its vectorised population slice sampler.

    The latter has 2 steps a parameter, a quarter of the points at once.
    """
    library = import_module("ultranest")
    logging.getLogger("ultranest").setLevel(logging.ERROR)
    np.random.seed(seed)  # noqa: NPY002 - ultranest draws from NumPy's global state
    n_live = n_live or 400
    names = [f"p{i}" for i in range(problem.n_params)]
    sampler = library.ReactiveNestedSampler(names, problem.batch, problem.from_unit, vectorized=True)
    if population:
        steps = import_module("ultranest.popstepsampler")
        sampler.stepsampler = steps.PopulationSimpleSliceSampler(
            popsize=n_live // 4,
            nsteps=2 * problem.n_params,
            generate_direction=steps.generate_mixture_random_direction,
        )
    found = sampler.run(min_num_live_points=n_live, show_status=False, viz_callback=False)
    converged = bool(found["insertion_order_MWW_test"]["converged"])
    samples = found["weighted_samples"]
    return Outcome(
        float(found["logz"]),
        float(found["logzerr"]),
        problem.n_evaluations,
        np.asarray(samples["points"]),
        _logs(samples["weights"]),
        n_live,
        doubts=() if converged else ("insertion order test failed",),
    )


def nautilus(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run nautilus as it comes; `n_live` is not passed on, since its live points build bounds and not the estimate."""
    library = import_module("nautilus")
    sampler = library.Sampler(
        problem.from_unit, problem.batch, n_dim=problem.n_params, vectorized=True, pass_dict=False, seed=seed
    )
    sampler.run(verbose=False)
    theta, log_weight, _ = sampler.posterior()
    error = float(sampler.n_eff) ** -0.5  # its documentation's estimate
    return Outcome(float(sampler.log_z), error, problem.n_evaluations, np.asarray(theta), np.asarray(log_weight))


def nestle(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run nestle with several ellipsoids."""
    library = import_module("nestle")
    n_live = n_live or 500
    found = library.sample(
        problem.single,
        problem.from_unit,
        problem.n_params,
        npoints=n_live,
        method="multi",
        dlogz=_REMAINING,
        rstate=np.random.RandomState(seed),  # what nestle takes
    )
    return Outcome(
        float(found.logz),
        float(found.logzerr),
        problem.n_evaluations,
        np.asarray(found.samples),
        _logs(found.weights),
        n_live,
    )


SAMPLERS = {
    "dynesty": Sampler(("dynesty",), dynesty),
    "dynesty-rslice": Sampler(("dynesty",), partial(dynesty, sample="rslice")),
    "dynesty-rwalk": Sampler(("dynesty",), partial(dynesty, sample="rwalk")),
    "ultranest": Sampler(("ultranest",), ultranest),
    "ultranest-pop": Sampler(("ultranest", "ultranest.popstepsampler"), partial(ultranest, population=True)),
    "nautilus": Sampler(("nautilus",), nautilus),
    "nestle": Sampler(("nestle",), nestle),
}

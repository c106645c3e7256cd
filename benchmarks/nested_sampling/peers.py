"""The peers, each by one small function at its documented settings; needs the `bench` extra.

All are given the same problem. Those that evaluate in batches get batches. `n_live` None leaves each its own default.
"""

from __future__ import annotations

import logging
import math
import time
from importlib import import_module
from typing import Any

import numpy as np

from nested_sampling.sampler import Counted, Outcome, Sampler

_REMAINING = 0.01  # nats: the remaining evidence at which the peers that are told stop; their usual choice


def _logs(weights: Any) -> Any:
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


def _dynesty(problem: Counted, seed: int, n_live: int | None, sample: str) -> Outcome:
    dynesty = import_module("dynesty")
    n_live = n_live or 500
    sampler = dynesty.NestedSampler(
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


def dynesty(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run dynesty as it comes: bounding ellipsoids, and the move it picks for the dimension."""
    return _dynesty(problem, seed, n_live, "auto")


def dynesty_rslice(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run dynesty with slices in random directions."""
    return _dynesty(problem, seed, n_live, "rslice")


def dynesty_rwalk(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run dynesty with random walks."""
    return _dynesty(problem, seed, n_live, "rwalk")


def _ultranest(problem: Counted, seed: int, n_live: int | None, population: bool) -> Outcome:
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


def ultranest(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run ultranest as it comes: region sampling (MLFriends)."""
    return _ultranest(problem, seed, n_live, population=False)


def ultranest_pop(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run ultranest's vectorised population slice sampler: 2 steps a parameter, a quarter of the points at once."""
    return _ultranest(problem, seed, n_live, population=True)


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


def blackjax(problem: Counted, seed: int, n_live: int | None) -> Outcome:
    """Run blackjax's nested slice sampling, compiled, a tenth of the live points at once.

    Twice as many slices a point as parameters and five at least, as its documentation asks; the remaining evidence
    stops it. Compiling its step is part of a run's cost, and is told apart too. Evaluations are counted from its own
    records: what stepping out and shrinking report, and two ends a slice.
    """
    jax = import_module("jax")
    jax.config.update("jax_enable_x64", True)
    jnp = import_module("jax.numpy")
    library = import_module("blackjax")
    utils = import_module("blackjax.ns.utils")
    traceable = problem.known.traceable
    if traceable is None:
        raise ValueError("blackjax needs a likelihood for jax.numpy, and this problem has none")
    n_live = n_live or 500

    def log_likelihood(u: Any) -> Any:
        return traceable.log_likelihood(traceable.from_unit(jnp.clip(u, 1e-12, 1 - 1e-12), jnp), jnp)

    def log_prior(u: Any) -> Any:
        return jnp.where(jnp.all((u > 0) & (u < 1)), 0.0, -jnp.inf)

    algorithm = library.nss(
        logprior_fn=log_prior,
        loglikelihood_fn=log_likelihood,
        num_inner_steps=max(5, 2 * problem.n_params),
        num_delete=max(1, n_live // 10),
    )
    key, first, last = jax.random.split(jax.random.PRNGKey(seed), 3)
    state = algorithm.init(jax.random.uniform(first, (n_live, problem.n_params)))
    problem.n_evaluations += n_live
    before = time.process_time()
    step = jax.jit(algorithm.step).lower(key, state).compile()
    compiling_s = time.process_time() - before
    dead: list[Any] = []
    while _remaining(state) > math.log(_REMAINING):
        key, now = jax.random.split(key)
        state, info = step(now, state)
        dead.append(info)
        problem.n_evaluations += _slices_cost(info.update_info)
    final = utils.finalise(state, dead, update_info=False)
    log_weights = np.nan_to_num(np.asarray(utils.log_weights(last, final, 200)), nan=-np.inf)
    log_z = np.logaddexp.reduce(log_weights, axis=0)
    theta = traceable.from_unit(np.asarray(final.particles.position), np)
    return Outcome(
        float(log_z.mean()),
        float(log_z.std()),
        problem.n_evaluations,
        theta,
        log_weights.mean(axis=1),
        n_live,
        compiling_s=compiling_s,
    )


def _remaining(state: Any) -> float:
    """Log of the live points' share of the evidence."""
    found = state.integrator
    return float(found.logZ_live) - float(np.logaddexp(float(found.logZ), float(found.logZ_live)))


def _slices_cost(info: Any) -> int:
    """Count the evaluations of one round of slices, wherever the record nests them."""
    if hasattr(info, "num_expansions"):
        expansions, shrinkages = np.asarray(info.num_expansions), np.asarray(info.num_shrink)
        return int(expansions.sum() + shrinkages.sum() + 2 * shrinkages.size)
    return sum(_slices_cost(part) for part in info) if isinstance(info, tuple) else 0


SAMPLERS = {
    "dynesty": Sampler(("dynesty",), dynesty),
    "dynesty-rslice": Sampler(("dynesty",), dynesty_rslice),
    "dynesty-rwalk": Sampler(("dynesty",), dynesty_rwalk),
    "ultranest": Sampler(("ultranest",), ultranest),
    "ultranest-pop": Sampler(("ultranest", "ultranest.popstepsampler"), ultranest_pop),
    "nautilus": Sampler(("nautilus",), nautilus),
    "nestle": Sampler(("nestle",), nestle),
    "blackjax": Sampler(("jax", "jax.numpy", "jax.scipy.special", "blackjax", "blackjax.ns.utils"), blackjax, True),
}

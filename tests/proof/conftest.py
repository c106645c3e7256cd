"""Results made by hand: of cases, with all said rightly unless a test says otherwise, and of runs of a study."""

import numpy as np


def hidden(name, size=8.0, *, cosines=None, on_noise=False, in_vocabulary=True, shows_in=("time",)):
    return {
        "name": name,
        "size_lambda": size,
        "on_noise": on_noise,
        "in_vocabulary": in_vocabulary,
        "shows_in": list(shows_in),
        "cosines": {name: 1.0} if cosines is None else cosines,
    }


def case(kind="clean", size=0.0, *, truth=(), hides=(), said=None, p=0.97, **others):
    said = list(truth) if said is None else list(said)
    verdict = {(): "clean", ("unknown",): "unknown"}.get(tuple(said), "named")
    scan = {"null": -120.0, "repaired": -100.0, "right": -100.0}
    return {
        "kind": kind,
        "size": size,
        "other_noise": False,
        "plan": "paper",
        "ssf": "gaussian",
        "noise_level": "low",
        "noise_model": "white",
        "readings": 408,
        "truth": list(truth),
        "hidden": list(hides),
        "alias": None,
        "cosine": None,
        "verdict": verdict,
        "p_value": 0.5 if not truth else 1e-4,
        "combination": said,
        "hypotheses": [[said, p], [["halo"], 1 - p]],
        "credible_set": ["+".join(said) or "clean"],
        "where": ["time"],
        "overlap": None,
        "parameters": {},
        "sensor": {"u_mm": [0.0, -1.0, 1.0]},
        "held_out": {name: dict(scan) for name in ("angle", "pattern", "direction")},
        "settled": None,
        "cpu_s": 4.0,
        **others,
    }


def system_case(kind="clean", size=0.0, *, truth=(), gains=(40.0, 40.0), **others):
    """Return a case of a system, with gains in nats over the null, of the repaired and of the right model."""
    repaired, right = (-100.0 + gain / 2 for gain in gains)
    run = {"null": -100.0, "repaired": repaired, "right": right}
    of_system = {"system": "tank", "law": True, "held_out": {"inside": run, "beyond": dict(run)}}
    hypotheses = {"hypotheses": [[list(others.get("said", truth)), others.get("p", 0.97)], [["lag"], 0.03]]}
    return case(kind, size, truth=truth, **(of_system | hypotheses | others))


def system_single(name="offset_drift", size=12.0, *, hide=None, **others):
    return system_case("single", size, truth=[name], hides=[hide or hidden(name, size, cosines={})], **others)


def search(readings=3, *, reached=True, **others):
    """Return a run of a study."""
    return {
        "reached": reached,
        "readings": readings,
        "error_mm": 1.0,
        "chance_wrong": 1e-4,
        "held": [True, True, True],
        "first_white": 2,
        "bits": 22.0,
        "bits_at_white": 9.0,
        "arm_s": 4.0 * readings,
        "cpu_s": 0.2,
        "widest_mm": np.geomspace(300.0, 3.0, readings).round(2).tolist(),
        "p_value": 0.4,
        **others,
    }


def single(name="lag", size=8.0, *, hide=None, **others):
    return case("single", size, truth=[name], hides=[hide or hidden(name, size)], **others)


def outside(size=12.0, *, name="chirp", cosines=None, **others):
    like = hidden(name, size, cosines=cosines or {}, in_vocabulary=False)
    return case("outside", size, truth=["unknown"], hides=[like], **others)

"""Other libraries get the same evidence and the same posterior; without them the error says what to install."""

import importlib
import math
import sys

import numpy as np
import pytest
from nested_sampling import problems

from probewise.nested import merge, run
from probewise.priors import Product, Uniform

WHY = "{0} is an optional package: pip install {0}"


def disc():
    """Impossible outside a disc, two levels of likelihood within."""
    prior = Product({"x": Uniform(-1, 1), "y": Uniform(-1, 1)})

    def function(theta):
        r2 = (theta**2).sum(axis=1)
        return np.where(r2 < 0.5, np.where(r2 < 0.1, 1.0, 0.0), -np.inf)

    return problems.Known(prior, function, math.log((0.4 + 0.1 * math.e) * math.pi / 4))


PROBLEMS = {"plateau": problems.plateau, "Rosenbrock 2-D": lambda: problems.rosenbrock(2), "partly impossible": disc}


@pytest.fixture(scope="module", params=[*PROBLEMS, "two runs"])
def result(request):
    if request.param == "two runs":
        rngs = np.random.default_rng(9).spawn(3)
        return merge([run(problems.plateau(), rng=rng, n_live=50) for rng in rngs[1:]], rng=rngs[0])
    return run(PROBLEMS[request.param](), rng=np.random.default_rng(4), n_live=100)


def test_levels_become_strict_in_the_order_of_labels_and_hardly_move(result):
    death, birth = result._log_likelihoods_without_ties()
    assert (np.diff(death) > 0).all()
    assert death == pytest.approx(result.log_likelihood + result.log_start, rel=1e-9, abs=1e-9)
    assert (birth < death).all()
    first = np.isneginf(result.log_birth)
    assert np.array_equal(np.isneginf(birth), first)
    assert birth[~first] == pytest.approx(result.log_birth[~first] + result.log_start, rel=1e-9, abs=1e-9)
    # The count of live points from strict levels alone, by comparing all pairs.
    alive = ((birth[None, :] < death[:, None]) & (death[None, :] >= death[:, None])).sum(axis=1)
    assert np.array_equal(alive, result.n_at_death)


def test_anesthetic_finds_the_same_evidence(result):
    pytest.importorskip("anesthetic", reason=WHY.format("anesthetic"), exc_type=ImportError)
    samples = result.to_anesthetic()
    assert len(samples) == result.n_dead
    assert np.array_equal(samples["nlive"].to_numpy(), result.n_at_death)
    assert samples.logZ() == pytest.approx(result.log_z, abs=0.3 * result.log_z_error)
    np.random.seed(0)  # noqa: NPY002 (anesthetic draws from the global state)
    spread = float(samples.logZ(400).std())
    assert spread == pytest.approx(math.sqrt(result.log_z_error**2 - result.log_start_error**2), rel=0.3)
    assert samples[list(result.names)].mean().to_numpy() == pytest.approx(result.mean(), abs=0.1 * result.sd().max())
    assert samples.D_KL() - result.log_start == pytest.approx(result.information, abs=0.1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning")  # ArviZ warns of its own successor on import
@pytest.mark.parametrize("module", ["arviz", "arviz_base"])
def test_arviz_gets_equally_weighted_samples_with_their_levels(module, result, monkeypatch):
    """ArviZ up to 0.23 and, by its base package, from 1.0 on."""
    pytest.importorskip(module, reason=WHY.format(module), exc_type=ImportError)
    monkeypatch.setitem(sys.modules, "arviz", importlib.import_module(module))
    data = result.to_arviz(rng=np.random.default_rng(2), n=500)
    rows = data["sample_stats"]["row"].values
    assert rows.shape == (1, 500)
    for i, name in enumerate(result.names):
        assert np.array_equal(data["posterior"][name].values, result.theta[rows, i])
        assert float(data["posterior"][name].mean()) == pytest.approx(result.mean()[i], abs=0.1 * result.sd()[i])
    assert np.array_equal(data["sample_stats"]["log_l"].values, result.log_likelihood[rows])
    assert (data["sample_stats"]["log_l_birth"].values <= data["sample_stats"]["log_l"].values).all()
    assert data.attrs["log_z"] == result.log_z
    assert data.attrs["inference_library"] == "probewise"
    fewer = result.to_arviz(rng=np.random.default_rng(2))
    assert fewer["posterior"].sizes["draw"] == int(result.n_eff)


@pytest.mark.parametrize("name", ["anesthetic", "arviz"])
def test_a_missing_package_is_named_with_its_install_line(name, result, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=f"pip install {name}$"):
        result.to_anesthetic() if name == "anesthetic" else result.to_arviz(rng=np.random.default_rng(0))

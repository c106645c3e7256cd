import numpy as np
import pytest

from probewise.calibration import FittedSensor, calibrate, choose_pixel_mm, posterior_mean_ssf_field
from probewise.recordings import Instrumentation, Recording, paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FreeLevels, FreeMixture, mixture_parameter_names

TRUTH = np.array([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0])
NOISE_SD = 0.5


def _sensor(n_samples=500, *, spread=1.0, effects=(), extra=None):
    """A sensor whose posterior is Gaussian about TRUTH; `extra` gives constant columns of effects."""
    rng = np.random.default_rng(11)
    sd = spread * np.array([0.0, 0.03, 0.03, 0.001, 0.002, 0.0005, 0.05, 0.05])
    samples = TRUTH + sd * rng.standard_normal((n_samples, 8))
    extra = extra or {}
    columns = np.broadcast_to(list(extra.values()), (n_samples, len(extra)))
    return FittedSensor(
        names=(*mixture_parameter_names(1), "I_min", "I_max", *extra),
        samples=np.concatenate([samples, columns], axis=1),
        n_gaussians=1,
        noise_sd=NOISE_SD * np.exp(0.05 * spread * rng.standard_normal(n_samples)),
        field=posterior_mean_ssf_field(samples, 1, pixel_mm=choose_pixel_mm(samples, 1, step_mm=1.0)),
        instrumentation=Instrumentation(unit="LEGO", min=0.0, max=100.0),
        effects=effects,
    )


@pytest.fixture(scope="session")
def sensor():
    return _sensor()


@pytest.fixture(scope="session")
def make_sensor():
    return _sensor


@pytest.fixture(scope="session")
def truth():
    return TRUTH


@pytest.fixture(scope="session")
def noise_sd():
    return NOISE_SD


@pytest.fixture(scope="session")
def recording():
    """Every third reading of the paper's four edge scans, by TRUTH with Gaussian noise."""
    plan = paper_plan().take(np.arange(0, 404, 3))
    clean = Chain(FreeMixture(1), FreeLevels(), KnownScene(plan.patterns)).predict(TRUTH[None], plan)[0]
    return Recording(plan, clean + NOISE_SD * np.random.default_rng(12).standard_normal(len(plan)), "edges.csv")


@pytest.fixture(scope="session")
def calibration(recording):
    return calibrate(recording, orders=(1,), n_live=50, rng=np.random.default_rng(13))

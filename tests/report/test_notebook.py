"""Results show themselves in a notebook, with a picture."""

import numpy as np
import pytest

from probewise._display import ShowsItself, render_html
from probewise.nested import run
from probewise.priors import Product, Uniform
from probewise.recordings import Recording, paper_plan
from probewise.sensor import SSFField


class Bell:
    prior = Product({"x_mm": Uniform(-5.0, 5.0), "y_mm": Uniform(-5.0, 5.0)})

    def log_likelihood(self, theta):
        return -0.5 * (theta**2).sum(axis=1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: run(Bell(), rng=np.random.default_rng(0), n_live=50),
        lambda: SSFField(np.ones((5, 5)), 1.0, (-2.0, -2.0)),
        lambda: Recording(paper_plan(), np.linspace(10, 60, 408)),
    ],
    ids=["nested result", "SSF field", "recording"],
)
def test_a_value_shows_a_picture(make):
    assert "data:image/png;base64" in make()._repr_html_()


def test_a_value_without_a_renderer_shows_its_escaped_summary():
    class Plain(ShowsItself):
        def summary(self):
            return "a < b\nand more"

    assert Plain()._repr_html_() == "<pre>a &lt; b\nand more</pre>"
    assert repr(Plain()) == "<Plain: a < b>"
    assert render_html(3) == "<pre>3</pre>"

"""Figures are closed after every test; no test opens a window."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

mpl.use("Agg")


@pytest.fixture(autouse=True)
def _figures_closed():
    yield
    plt.close("all")

"""Fits of the world's systems: what they refuse."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.errors import NotConvergedError
from probewise.proof.systems.fit import ModelWithForms

from .conftest import small


def test_fit_that_ends_where_the_law_diverges_is_refused():
    kind, rows, _ = small()
    runaway = replace(kind, text=kind.text.replace('u["u"] - p["k"] * s["x"]', 'p["k"] * 50 * s["x"] ** 2'))
    with pytest.raises(NotConvergedError, match="ended where its law diverges"):
        ModelWithForms(runaway, rows, []).fit(np.zeros(len(rows)), np.array([0.9]))

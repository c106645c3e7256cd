"""Principal axes of small Gram matrices in closed form, against the general solver."""

import numpy as np
import pytest

from probewise.diagnosis.templates import _gram_eigensystems


@pytest.mark.parametrize("width", [1, 2, 3])
def test_closed_forms_are_those_of_the_general_solver(width):
    columns = np.random.default_rng(3).standard_normal((50, 9, width))
    if width > 1:
        columns[0, :, 1] = columns[0, :, 0] * 2  # one axis only
        columns[1] = 0.0
    squares = columns.transpose(0, 2, 1) @ columns
    values, axes = _gram_eigensystems(squares)
    assert np.sort(values, axis=1) == pytest.approx(np.linalg.eigvalsh(squares), abs=1e-12)
    assert (axes * values[:, None, :]) @ axes.transpose(0, 2, 1) == pytest.approx(squares, abs=1e-12)

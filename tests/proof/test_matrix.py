"""The subset of whole commands that runs for every change is of cells that exist."""

from pathlib import Path

import matrix


def test_the_subset_for_every_change_is_of_cells_that_exist():
    keys = Path(matrix.__file__).with_name("matrix_ci.txt").read_text().splitlines()
    assert len(keys) == len(set(keys)) > 40
    assert set(keys) <= set(matrix.all_cells(52))

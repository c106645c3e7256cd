"""The page of an audit: its matrix says how it is read, its sizes are in words with units."""

import numpy as np

from probewise.report.plots import audit_matrix

NAMES = ["lag", "backlash", "outliers"]
COSINES = np.array([[0.9, 0.97, 0.0], [0.3, 0.8, 0.0], [0.0, 0.0, 1.0]])


def test_the_matrix_marks_the_row_that_is_taken_for_the_column_and_leaves_out_what_is_not_compared():
    _, matrix = audit_matrix(NAMES, ["aliased", "fine", "fine"], COSINES, alias=0.95)[0]
    rows = [label.get_text() for label in matrix.figure.axes[0].get_yticklabels()]
    assert rows == ["outliers  1", "backlash  2", "lag  3"]
    image = np.ma.filled(matrix.images[0].get_array(), np.nan)
    assert [label.get_text() for label in matrix.get_xticklabels()] == ["2", "3"]  # of the effects compared
    assert (image[2, 0], image[1, 1]) == (0.97, 0.3)
    assert np.isnan(image[0]).all()
    (circle,) = zip(*matrix.lines[0].get_data(), strict=True)
    assert circle == (0, 2)
    assert "row: the effect present" in matrix.get_title(loc="left")

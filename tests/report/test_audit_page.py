"""The page of an audit: its matrix says how it is read, its sizes are in words with units."""

import numpy as np
import pytest

from probewise.diagnosis import EffectAudit
from probewise.diagnosis.audit import DetectableSize
from probewise.report.audit import audit_table
from probewise.report.plots import audit_matrix

NAMES = ["lag", "backlash", "outliers"]
COSINES = np.array([[0.9, 0.97, 0.0], [0.3, 0.8, 0.0], [0.0, 0.0, 1.0]])


def test_the_matrix_marks_the_row_that_is_taken_for_the_column_and_leaves_out_what_is_not_compared():
    _, matrix = audit_matrix(NAMES, ["aliased", "fine", "fine"], COSINES, alias=0.95)[0]
    rows = [label.get_text() for label in matrix.figure.axes[0].get_yticklabels()]
    columns = [label.get_text() for label in matrix.get_xticklabels()]
    image = np.ma.filled(matrix.images[0].get_array(), np.nan)
    assert image[rows.index("lag"), columns.index("backlash")] == 0.97
    assert image[rows.index("backlash"), columns.index("lag")] == 0.3
    assert np.isnan(image[rows.index("outliers")]).all()
    assert "outliers" not in columns
    (circle,) = zip(*matrix.lines[0].get_data(), strict=True)
    assert circle == (columns.index("backlash"), rows.index("lag"))
    assert "row: the effect present" in matrix.get_title(loc="left")
    assert matrix.get_xlabel() == "effect it may be mistaken for"


@pytest.mark.parametrize(
    ("size", "said"),
    [
        (DetectableSize("per_volt", "1/V", 0.069), "relative change 0.069 per V"),
        (DetectableSize("a", "1 per temp_c", 0.069), "a 0.069 per temp_c"),
        (DetectableSize("b", "1/s", 0.069), "b 0.069 per s"),
        (DetectableSize("per_mm_x", "LEGO/mm", 0.014), "along X 0.014 LEGO units per mm"),
        (DetectableSize("amp", "LEGO", 0.55), "amplitude 0.55 LEGO units"),
        (DetectableSize("mm_per_mm", "mm/mm", 0.0015), "slope 0.0015 mm per mm"),
        (DetectableSize("ceiling_v", "V", None), "ceiling v at no size"),
        (DetectableSize("gain", "W/m2", 3.0), "gain 3 W/m2"),
    ],
    ids=lambda value: value.parameter if isinstance(value, DetectableSize) else "",
)
def test_a_size_is_in_words_with_its_unit(size, said):
    assert f">{said}<" in audit_table([EffectAudit("lag", "fine", 0.9, smallest=(size,))])

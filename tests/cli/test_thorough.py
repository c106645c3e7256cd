"""`probewise diagnose --thorough`: what leads is weighed twice, and the files say so."""

import json

import jsonschema
import pytest

from probewise.cli import main
from probewise.diagnosis import diagnosis_schema


@pytest.mark.slow
def test_a_thorough_diagnosis_states_both_evidences(recording_file, sensor_file, tmp_path):
    out = tmp_path / "out"
    given = ["diagnose", recording_file, "--sensor", sensor_file, "--thorough", "--out", out, "--quiet"]
    assert main([str(word) for word in given]) == 0
    document = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    jsonschema.validate(document, diagnosis_schema())
    assert [] in [weighed["effects"] for weighed in document["thorough"]]
    assert all(weighed["agree"] for weighed in document["thorough"])
    assert document["reason"].endswith("nested sampling agrees to within a nat plus its standard error.")
    assert "ln Z, nested sampling" in (out / "report.html").read_text(encoding="utf-8")

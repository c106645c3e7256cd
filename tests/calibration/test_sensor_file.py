import json
from dataclasses import replace

import numpy as np
import pytest

from probewise.calibration import FittedSensor, OrderEvidence, PriorRow, ScanNoise, read_sensor, write_sensor
from probewise.errors import FileError, ParameterError, ShapeError


def _full(sensor):
    return replace(
        sensor,
        orders=(OrderEvidence(1, -320.5, 0.3), OrderEvidence(2, -326.0, 0.4)),
        priors=(PriorRow("a_n", "1", "uniform 0 to 1", "only ratios reach the data"),),
        scan_noise=(ScanNoise("edge_0", 101, 0.5, 0.03),),
        notes=("something to know",),
        fingerprint="ab12",
        source="rec.csv",
    )


def test_a_sensor_survives_its_file(sensor, tmp_path):
    full = _full(sensor)
    write_sensor(full, tmp_path / "sensor.json")
    back = read_sensor(tmp_path / "sensor.json")
    np.testing.assert_array_equal(back.samples, full.samples)
    np.testing.assert_array_equal(back.noise_sd, full.noise_sd)
    np.testing.assert_allclose(back.field.values, full.field.values, rtol=1e-12)
    assert (back.field.pixel_mm, back.field.origin_mm) == (full.field.pixel_mm, full.field.origin_mm)
    for name in ("names", "orders", "priors", "scan_noise", "notes", "fingerprint", "source", "instrumentation"):
        assert getattr(back, name) == getattr(full, name)
    assert list(tmp_path.iterdir()) == [tmp_path / "sensor.json"]


def test_an_effect_of_some_patterns_is_so_after_the_file_too(sensor, tmp_path):
    shadow = np.tile([0.02, 3.0], (len(sensor.samples), 1))
    shaded = replace(
        sensor,
        names=(*sensor.names, "edge_shadow.amp", "edge_shadow.w"),
        samples=np.concatenate([sensor.samples, shadow], axis=1),
        effects=("edge_shadow",),
        patterns={"edge_shadow": ("boundary",)},
    )
    write_sensor(shaded, tmp_path / "sensor.json")
    back = read_sensor(tmp_path / "sensor.json")
    assert back.patterns == shaded.patterns
    (effect,) = back.effects_on_new_scans
    assert effect.name == "edge_shadow"
    assert effect.patterns == ("boundary",)
    (everywhere,) = replace(shaded, patterns={}).effects_on_new_scans
    assert everywhere.patterns == ()
    for stray in ({"edge_blur": ("boundary",)}, {"lag": ("boundary",)}):
        with pytest.raises(ParameterError, match="effects of the model among"):
            replace(shaded, patterns=stray)
    document = json.loads(shaded.to_json())
    document["patterns"]["edge_shadow"] = 3
    with pytest.raises(FileError, match=r"patterns\.edge_shadow is 3"):
        FittedSensor.from_json(json.dumps(document))
    document.pop("patterns")  # a file of before
    assert FittedSensor.from_json(json.dumps(document)).patterns == {}


def _without(*keys):
    def change(document):
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


def _with(value, *keys):
    def change(document):
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_with("sensor/2", "format"), "format 'sensor/2'; allowed: 'sensor/1'"),
        (_without("samples"), "no samples"),
        (_without("noise", "sd"), "no noise.sd"),
        (_with(float("nan"), "noise", "sd", 0), "NaN"),
        (_with([1.0], "samples", 3), "equal dimensions"),
        (_with([[1.0] * 8] * 3, "samples"), "500 or more"),
        (_with(2, "n_gaussians"), "n_gaussians is 2; allowed: 1 to 1"),
        (_with(1.5, "n_gaussians"), "a whole number"),
        (_with(-1.0, "field", "pixel_mm"), "pixel_mm"),
        (_with(["gremlins"], "effects"), "gremlins"),
        (_with("text", "orders"), "orders is 'text'; allowed: a list"),
        (_with({"lag": [0, 3.5]}, "absent"), "whole numbers from 0 to 499"),
        (_with(-5.0, "samples", 0, 3), "A B - C"),
        (_with(None, "instrumentation", "unit"), "a text"),
    ],
)
def test_damaged_files_say_where(sensor, tmp_path, change, message):
    document = json.loads(_full(sensor).to_json())
    change(document)
    path = tmp_path / "sensor.json"
    path.write_text(json.dumps(document))
    with pytest.raises(FileError) as caught:
        read_sensor(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "allowed: " in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2]", b"\xff\xfe\x00", b'"sensor/1"'])
def test_what_is_no_sensor_at_all_is_refused(tmp_path, content):
    path = tmp_path / "sensor.json"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"sensor\.json"):
        read_sensor(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {"samples": s.samples[:100], "noise_sd": s.noise_sd[:100]}, "500 or more"),
        (lambda s: {"samples": s.samples[:, :7]}, "samples have shape"),
        (lambda s: {"noise_sd": s.noise_sd[:9]}, "one per sample"),
        (lambda s: {"noise_sd": -s.noise_sd}, "greater than 0"),
        (lambda s: {"effects": ("backlash",)}, "after I_max the columns"),
    ],
)
def test_a_sensor_must_hold_together(sensor, change, message):
    with pytest.raises((ParameterError, ShapeError), match=message):
        replace(sensor, **change(sensor))


def test_the_summary_names_every_parameter_and_the_preferred_order(sensor):
    text = _full(sensor).summary()
    assert all(name in text for name in sensor.names)
    assert "-320.50 ± 0.30  most probable" in text
    assert "something to know" in text

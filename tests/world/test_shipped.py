"""What ships is what the seeds make, and what it conceals has the size that is said."""

import numpy as np
import pytest

from probewise.arm import ReadingScale, read_geometry, shipped_geometry_path
from probewise.cli._bench import plan_for_lego_arm
from probewise.errors import ParameterError
from probewise.recordings import paper_plan, read_recording, shipped
from probewise.world.shipped import CANDIDATES, main, regenerate_recording, true_world


@pytest.fixture(scope="module")
def made_again(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    main([str(folder)])
    return folder


@pytest.mark.parametrize("name", ["paper", "concealed"])
@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_the_shipped_files_are_made_again_byte_for_byte(made_again, name, suffix):
    assert (made_again / f"{name}{suffix}").read_bytes() == shipped(name).with_suffix(suffix).read_bytes()


def test_the_files_do_not_tell_what_they_conceal():
    text = shipped("concealed").with_suffix(".json").read_text()
    assert not any(effect.name in text for effect in CANDIDATES)


def test_the_paper_recording_is_what_the_arm_records():
    """Whole LEGO units from 1 to 100, declared as the arm declares them."""
    recording = read_recording(shipped("paper"))
    scale = ReadingScale()
    np.testing.assert_array_equal(recording.readings, [scale.clip_and_round(r) for r in recording.readings])
    of_arm = plan_for_lego_arm(paper_plan(), read_geometry(shipped_geometry_path())).instrumentation
    ours = recording.plan.instrumentation
    assert (ours.min, ours.max, ours.step) == (of_arm.min, of_arm.max, of_arm.step) == (1.0, 100.0, 1.0)


def test_a_recording_that_does_not_ship_cannot_be_made():
    with pytest.raises(ParameterError):
        regenerate_recording("other")


def test_the_paper_recording_conceals_nothing_and_the_other_one_thing():
    assert true_world("paper").concealed == ()
    assert len(true_world("concealed").concealed) == 1

"""A diagnosis put together by hand."""

import pytest

from probewise.diagnosis import Diagnosis, Judged, VerdictReport
from probewise.diagnosis.judgement.judged import Hypothesis

JUDGED = Judged("clean", (), 0.4, (Hypothesis((), 1.0),))
FOUND = Diagnosis(None, JUDGED, None, (), None, VerdictReport("All is explained.", (), None), None)


def test_what_is_read_most_is_at_hand():
    assert (FOUND.verdict, FOUND.reason, FOUND.p_value) == ("clean", "All is explained.", 0.4)


def test_names_of_the_last_release_are_answered_with_a_warning():
    with pytest.warns(DeprecationWarning, match=r"credible is Diagnosis\.judged\.credible"):
        assert FOUND.credible == ("clean",)


def test_a_name_that_never_was_is_no_attribute():
    with pytest.raises(AttributeError, match="credibility"):
        FOUND.credibility  # noqa: B018

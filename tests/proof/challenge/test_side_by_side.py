"""Two campaigns beside each other: what is counted of cases that changed."""

import lzma

import challenges_side_by_side as side_by_side
import pytest

from probewise.proof.campaign import Campaign, read_campaign


def _case(kind, p_value, verdict="clean", combination=(), **more):
    names = list(combination)
    return {
        "kind": kind, "size": 12.0, "truth": [], "hidden": [], "verdict": verdict, "p_value": p_value,
        "combination": names, "hypotheses": [[names, 1.0]], "credible_set": ["+".join(names) or "clean"], **more,
    }  # fmt: skip


def test_cases_that_changed_are_counted_with_the_probability_of_their_difference():
    earlier = [_case("clean", 0.04)] * 3 + [_case("clean", 0.5)] * 10
    later = [_case("clean", 0.5)] * 3 + [_case("clean", 0.02)] * 2 + [_case("clean", 0.5)] * 8
    rows = {row["what"]: row for row in side_by_side.changed_counts(earlier, later)}
    alarms = rows["clean, alarm at .05"]
    assert [alarms[k] for k in ("cases", "earlier", "later", "only earlier", "only later")] == [13, 3, 2, 3, 2]
    assert alarms["p_value"] == 1.0
    assert rows["clean, alarm at .01"]["p_value"] == 1.0
    assert rows["single effect, right name first"]["cases"] == 0


def test_six_cases_lost_and_none_won_have_the_binomial_probability():
    outside = {"hidden": [{"name": "after_glow", "in_vocabulary": False, "cosines": {}, "on_noise": False}]}
    lost = _case("outside", 0.001, "unknown", ["unknown"], **outside)
    named = _case("outside", 0.001, "named", ["halo"], **outside)
    (row,) = (
        row
        for row in side_by_side.changed_counts([lost] * 6, [named] * 6)
        if row["what"] == "out of vocabulary, unknown or named right"
    )
    assert (row["only earlier"], row["only later"]) == (6, 0)
    assert row["p_value"] == pytest.approx(2 / 2**6, abs=1e-4)


def _square(number):
    return {"square": number**2}


def test_a_packed_campaign_is_read_as_an_unpacked_one(tmp_path):
    cases = tmp_path / "cases.jsonl"
    Campaign(_square, {f"seed / {k}": k for k in range(3)}, {"seed": 1}).run(path=cases)
    packed = tmp_path / "cases.jsonl.xz"
    packed.write_bytes(lzma.compress(cases.read_bytes()))
    assert read_campaign(packed) == read_campaign(cases)
    assert len(read_campaign(packed).results) == 3

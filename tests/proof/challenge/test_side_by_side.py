"""Two campaigns beside each other: what is counted of cases that changed."""

import challenges_side_by_side as side_by_side


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

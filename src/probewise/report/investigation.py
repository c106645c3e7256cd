"""The page of an investigation: the diagnosis after each round, the reason for the next readings, the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from probewise._words import count_with_noun
from probewise._writing import Output, StagedFiles
from probewise.diagnosis import join, p_in_words
from probewise.diagnosis.words import hypothesis_in_words
from probewise.effects import spoken_name
from probewise.investigation import Investigation, Round
from probewise.recordings import write_recording
from probewise.report import diagnosis as diagnosis_report
from probewise.report.headline import headline
from probewise.report.html import Section, figure, page, seed_fact, table
from probewise.report.plots.canvas import png
from probewise.report.plots.probabilities import probabilities_by_round
from probewise.report.words import probability_text, typeset_numbers

_MOST_TOLD = 4
_LEAST_TOLD = 0.005


def draw_probabilities_by_round(found: Investigation) -> Axes:
    """Draw the probability of each explanation after each round; return the axes."""
    return probabilities_by_round({_round_title(each): _probability_by_explanation(each) for each in found.rounds})


def summary_sentence(found: Investigation) -> str:
    """Return an investigation's last headline, the readings beyond the first plan, and whether they settled it."""
    extra = found.extra_readings
    taken = (
        f"{count_with_noun(extra, 'reading')} beyond the first plan" if extra else "No reading beyond the first plan"
    )
    came = "settled it" if found.last.settled else "did not settle it"
    return f"{headline(found.last.diagnosis)} {taken} {came}."


def page_html(
    found: Investigation,
    drawn: Mapping[str, bytes],
    *,
    source: str,
    seed: int | None,
    concealed: Sequence[str] | None = None,
) -> str:
    """Return the HTML of an investigation's page; `drawn` has the last diagnosis's figures, and by_round.png.

    `concealed` are the effects that a simulated world concealed, None for any other arm.
    """
    hidden = ", ".join(map(spoken_name, concealed or ())) or "nothing"
    diagnosis = found.last.diagnosis
    said = "Probability of each explanation after each round, given all readings so far."
    n_readings, rounds = sum(len(each.recording) for each in found.rounds), count_with_noun(len(found.rounds), "round")
    run = {"arm": source, "readings": f"{n_readings} in {rounds}", **seed_fact(seed)}
    run |= {} if concealed is None else {"the world concealed": hidden}
    sections = [
        Section("How it came to that", (), tuple(_round_section(each) for each in found.rounds)),
        Section("The diagnosis of all readings", (), tuple(diagnosis_report.sections(diagnosis, drawn))),
        Section("This run", (run,)),
    ]
    return page(
        f"Investigation: {diagnosis.verdict.replace('_', ' ')} after {rounds}",
        answer=summary_sentence(found),
        key_figure=figure(drawn["by_round.png"], said),
        sections=sections,
        with_terms=True,
    )


def _round_title(each: Round) -> str:
    n = count_with_noun(len(each.recording), "reading")
    return f"round {each.number}: {n}" if each.number == 1 else f"round {each.number}: {len(each.recording)} more"


def _probability_by_explanation(each: Round) -> dict[str, float]:
    out: dict[str, float] = {}
    for hypothesis in each.diagnosis.hypotheses:
        name = hypothesis_in_words(hypothesis.effects)
        out[name] = out.get(name, 0.0) + hypothesis.probability
    return out


def _round_section(each: Round) -> Section:
    """Build the section of one round: the readings and their reason, the diagnosis, the next plan."""
    diagnosis = each.diagnosis
    why = "as the first plan lists them" if each.number == 1 else f"as requested: {each.reason_for_readings}"
    likely = [(name, p) for name, p in _probability_by_explanation(each).items() if p >= _LEAST_TOLD][:_MOST_TOLD]
    asked = diagnosis.next_measurement
    between = (
        "" if asked is None or len(asked.between) < 2 else f", which tell {asked.between[0]} from {asked.between[1]}"
    )
    if each.stop_reason is not None:
        then = f"The investigation ends: {each.stop_reason}."
    elif asked is None:
        then = ""
    else:
        then = f"Next readings: {asked.description}{between} (about {asked.minutes:.0f} minutes)."
    taken = count_with_noun(len(each.recording), "reading").capitalize()
    said = (
        typeset_numbers(f"{taken} were taken, {why}."),
        typeset_numbers(f"Test of all readings so far against the model's mean: {p_in_words(diagnosis.p_value)}."),
        table(("explanation", "probability"), ((name, probability_text(p)) for name, p in likely)),
        typeset_numbers(then),
    )
    title = _round_title(each)
    return Section(title[:1].upper() + title[1:], said)


def output_of(
    value: Investigation,
    *,
    seed: int | None = None,
    rng: np.random.Generator | None = None,
    source: str = "the arm",
    concealed: Sequence[str] | None = None,
) -> Output:
    """Return the files of an investigation: those of its last diagnosis, and recording.csv; figures and page.

    `rng` as of a diagnosis; `source` names the arm; `concealed` are the effects of a simulated world, None for any
    other.
    """
    last = diagnosis_report.output_of(value.last.diagnosis, seed=seed, rng=rng)

    def write_files(stage: StagedFiles) -> None:
        last.files(stage)
        write_recording(join([each.recording for each in value.rounds]), stage / "recording.csv")

    page = partial(page_html, value, source=source, seed=seed, concealed=concealed)
    by_round = {"by_round.png": lambda: png(draw_probabilities_by_round(value))}
    return last._replace(files=write_files, drawers={**last.drawers, **by_round}, page=page)

"""Fit the sensor without effects: with SSFs of one Gaussian, of free form, and of more Gaussians."""

from __future__ import annotations

from probewise.diagnosis.fitting.coordinates import default_sensor
from probewise.diagnosis.fitting.fit import Model, start_with_more_gaussians, starts_of_one_gaussian
from probewise.diagnosis.fitting.free_form import FreeForm
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.noise.law import white
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.weighed_fit import STEERING
from probewise.effects import Extent

__all__ = ["fit_nulls"]


def fit_nulls(state: SearchState, sensor: Null | None, *, max_order: int) -> None:
    """Fit what is believed of the sensor, or each form of the SSF: one Gaussian, the free form, more Gaussians.

    Up to one more than `max_order`, as long as the last is not far behind the best. Noises that only show in pairs are
    added once a null is known.
    """
    noises, refits = state.noises, state.refits
    recording = noises.recording
    plan, law = recording.plan, white(int(recording.usable.sum()), least=noises.least_sd)
    if sensor is not None:
        state.sensors[sensor.n_gaussians] = sensor
        state.keep(refits.weighed(Model(sensor, (), plan), sensor.starts, law))
    else:
        first = state.sensors[1] = default_sensor(Extent.of(recording), 1)
        last = state.keep(refits.weighed(Model(first, (), plan), starts_of_one_gaussian(first), law))
        if max_order > 1:
            free = FreeForm.about(first)
            state.sensors[free.n_gaussians] = free
            bent = refits.weighed(Model(free, (), plan), free.start_from(last.found.z), refits.law_of(last))
            best = max(state.keep(bent).log_z, last.log_z)
            for n in range(2, max_order + 2):
                # One more than the best is always a rival; beyond one that is far behind nothing is to be found.
                if n > 2 and last.log_z < best - STEERING:
                    break
                wanted = state.sensors[n] = default_sensor(Extent.of(recording), n)
                starts = start_with_more_gaussians(last.found.model.sensor, last.found.z, wanted)
                last = state.keep(refits.weighed(Model(wanted, (), plan), starts, refits.law_of(last)))
                best = max(best, last.log_z)
    if noises.pair_up(state.null.found, state.null.evidence):
        for candidate in state.nulls:
            state.keep(candidate.with_evidence(noises.weigh(candidate.found)))

"""The paper's figures and others, one function each: data first, then the axes to draw on, which are returned.

Without axes, a function opens a pyplot figure of suitable size, so that `plt.savefig` and `plt.show` find it; no global
style is set. A file is imported when one of its functions is first used.

The arm (figure 1 of the paper), data of the four orientations (figure 5), SSF by number of Gaussians (figure 6),
predicted against recorded (figure 7), the entropy map with its hypotheses (figures 2 and 8);
and also: progress towards the target precision, results of a diagnosis, and diagnostics of nested sampling.
"""

import importlib
from typing import Any

_FILES = {
    "apparatus": "draw_arm_lengths reach_map",
    "canvas": "AxesGrid PAGE_IN SMALL_PT grid_of_axes png stack_of_axes svg",
    "nested": "corner_plot insertion_plot run_plot trace_plot",
    "probabilities": "audit_matrix effect_probabilities_by_reading hypothesis_probabilities probabilities_by_round",
    "readings": "predicted_and_recorded_by_scan readings_by_orientation standardised_residuals",
    "residuals": "heldout_gain_by_scan mean_residuals_along readings_in_order "
    "readings_modulo_step recorded_against_predicted residual_autocorrelation residual_histogram "
    "residuals_against_covariates scan_with_residuals spread_by_level",
    "search": "draw_field_legend information_gained playing_field posterior_widths",
    "ssf": "spatial_sensitivity ssf_by_n_gaussians",
}
_FILE_OF = {name: file for file, names in _FILES.items() for name in names.split()}

__all__ = sorted(_FILE_OF)


def __getattr__(name: str) -> Any:
    """Import a function's file when it is first used (PEP 562)."""
    if name not in _FILE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_FILE_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__

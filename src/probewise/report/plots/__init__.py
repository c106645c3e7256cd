"""The paper's figures and others, one function each: data first, then the axes to draw on, which are returned.

Without axes, a function opens a pyplot figure of suitable size, so that `plt.savefig` and `plt.show` find it; no global
style is set.

The arm and its sensor (figure 1 of the paper), the sensor's orientations and the quadrant patterns (figures 3 and 4),
data of the four orientations (figure 5 of the paper), SSF by number of Gaussians (figure 6),
predicted against recorded (figure 7), the entropy map with its hypotheses (figures 2 and 8);
and also: progress towards the target precision, results of a diagnosis, and diagnostics of nested sampling.
"""

from probewise.report.plots.apparatus import arm_and_sensor
from probewise.report.plots.arm import reach_map
from probewise.report.plots.audit import audit_matrix
from probewise.report.plots.canvas import PAGE_IN, SMALL_PT, AxesGrid, grid_of_axes, png, stack_of_axes, svg
from probewise.report.plots.doubt import effect_probabilities_by_reading
from probewise.report.plots.fit import recorded_against_predicted
from probewise.report.plots.nested import corner_plot, insertion_plot, run_plot, trace_plot
from probewise.report.plots.noise import (
    lost_readings_against_predicted,
    readings_modulo_step,
    residual_autocorrelation,
    residual_histogram,
    spread_by_level,
)
from probewise.report.plots.patterns import quadrant_patterns, sensor_orientations
from probewise.report.plots.prediction import predicted_and_recorded_by_scan, residuals_against, standardised_residuals
from probewise.report.plots.progress import information_gained, posterior_widths
from probewise.report.plots.readings import readings_by_orientation
from probewise.report.plots.residuals import (
    heldout_gain_by_scan,
    mean_residuals_along,
    readings_in_order,
    residuals_against_covariates,
    scan_with_residuals,
)
from probewise.report.plots.scans import readings_before_and_after_repair, residuals_by_scan
from probewise.report.plots.scene import draw_field_legend, playing_field
from probewise.report.plots.ssf import spatial_sensitivity, ssf_by_n_gaussians
from probewise.report.plots.verdict import hypothesis_probabilities, probabilities_by_round

__all__ = [
    "PAGE_IN",
    "SMALL_PT",
    "AxesGrid",
    "arm_and_sensor",
    "audit_matrix",
    "corner_plot",
    "draw_field_legend",
    "effect_probabilities_by_reading",
    "grid_of_axes",
    "heldout_gain_by_scan",
    "hypothesis_probabilities",
    "information_gained",
    "insertion_plot",
    "lost_readings_against_predicted",
    "mean_residuals_along",
    "playing_field",
    "png",
    "posterior_widths",
    "predicted_and_recorded_by_scan",
    "probabilities_by_round",
    "quadrant_patterns",
    "reach_map",
    "readings_before_and_after_repair",
    "readings_by_orientation",
    "readings_in_order",
    "readings_modulo_step",
    "recorded_against_predicted",
    "residual_autocorrelation",
    "residual_histogram",
    "residuals_against",
    "residuals_against_covariates",
    "residuals_by_scan",
    "run_plot",
    "scan_with_residuals",
    "sensor_orientations",
    "spatial_sensitivity",
    "spread_by_level",
    "ssf_by_n_gaussians",
    "stack_of_axes",
    "standardised_residuals",
    "svg",
    "trace_plot",
]

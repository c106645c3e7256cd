"""A bank of templates, with products computed once and Bayes factors about any fit.

A fit absorbs a part of each template; the products needed for this are computed once for each noise model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.laplace import Linearised, average_over_amplitude_scales
from probewise.diagnosis.noise.law import NoiseLaw

_ABSENT = 1e-9  # share of a template's sum of squares below which its projection is rounding error
_REMEMBERED = 5  # most recent noise models in the cache, up to `_MOST_BYTES`
_MOST_BYTES = 2**28


@dataclass(eq=False)
class TemplateBank:
    """Labelled templates, concatenated by columns, with their Bayes factors about any fit.

    Parameters
    ----------
    columns
        Columns of all templates, (n_points, n_columns).
    widths
        Number of columns of each template, (n_templates,).
    labels
        Label of each template; several may have the same, such as the name of their effect.
    """

    columns: FloatArray
    widths: IntArray
    labels: tuple[str, ...]
    _whitened: dict[tuple[bytes, ...], _WhitenedTemplatesAndGrams] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, templates: Sequence[FloatArray], labels: Sequence[str], n_points: int) -> TemplateBank:
        """Concatenate templates, each (n_points, k), with one label each."""
        widths = np.array([t.shape[1] for t in templates], dtype=np.int64)
        return cls(np.concatenate([np.zeros((n_points, 0)), *templates], axis=1), widths, tuple(labels))

    def __getitem__(self, at: int) -> FloatArray:
        """Return template number `at`, (n_points, k)."""
        first = int(self._first_columns[at])
        return self.columns[:, first : first + int(self.widths[at])]

    @cached_property
    def _first_columns(self) -> IntArray:
        return np.cumsum(self.widths) - self.widths

    @cached_property
    def indices_by_label(self) -> dict[str, IntArray]:
        """Indices of the templates of each label."""
        labels = np.array(self.labels)
        return {label: np.flatnonzero(labels == label) for label in dict.fromkeys(self.labels)}

    def take_templates(self, members: IntArray) -> TemplateBank:
        """Return a bank of the templates with these indices, in this order."""
        at = [self._first_columns[k] + np.arange(self.widths[k]) for k in members]
        columns = np.concatenate([np.zeros(0, dtype=np.int64), *at])
        return TemplateBank(self.columns[:, columns], self.widths[members], tuple(self.labels[k] for k in members))

    def log_bayes_factors(self, problem: Linearised, residuals: FloatArray | None = None) -> FloatArray:
        """Return the log Bayes factor of adding each template to a fit, as `block_log_bayes_factors` does.

        Parameters
        ----------
        problem
            The fit, linearised.
        residuals
            Projected residuals, (n_rows, n_draws); the fit's own by default.

        Returns
        -------
        Log Bayes factors, (n_templates, n_draws).
        """
        own = problem.residual[:, None] if residuals is None else residuals
        n, n_kept = problem.n_points, problem.n_kept
        whitened = self._whitened_under(problem.law)
        taken = problem.basis[:n].T @ whitened.templates  # the part that the fit absorbs, (n_params, n_columns)
        along = whitened.templates.T @ own[:n]
        total = np.maximum(np.sum(own**2, axis=0), 1e-300)
        out = np.empty((len(self.widths), own.shape[1]))
        for width, products in whitened.products.items():  # all templates of one width at a time
            members, at = self._template_and_column_indices(width)
            absorbed = taken[:, at].transpose(1, 0, 2)
            left = products - absorbed.transpose(0, 2, 1) @ absorbed
            gain, axes = _gram_eigensystems(left)
            gain = np.where(gain > _ABSENT * n_kept, gain, 0.0)
            turned = axes.transpose(0, 2, 1) @ along[at]
            explained = turned**2 / np.where(gain > 0, gain, np.inf)[:, :, None] / total
            out[members] = average_over_amplitude_scales(explained, gain, n_kept)
        return out

    def unabsorbed_shares(self, problem: Linearised) -> FloatArray:
        """Return the share of each template's norm that a fit does not absorb, (n_templates,)."""
        templates = self._whitened_under(problem.law).templates
        taken = problem.basis[: problem.n_points].T @ templates
        whole, lost = (np.add.reduceat(np.sum(a**2, axis=0), self._first_columns) for a in (templates, taken))
        return np.asarray(np.sqrt(np.maximum(1 - lost / np.maximum(whole, 1e-300), 0.0)))

    def _template_and_column_indices(self, width: int) -> tuple[IntArray, IntArray]:
        """Return the indices of the templates of one width, (n,), and of their columns, (n, width)."""
        members = np.flatnonzero(self.widths == width)
        return members, self._first_columns[members, None] + np.arange(width)

    def _whitened_under(self, law: NoiseLaw) -> _WhitenedTemplatesAndGrams:
        """Whiten all templates, scaled to unit rms each, with Gram matrices; cached for the last few noise models."""
        key = law.whitening_key
        if key in self._whitened:
            self._whitened[key] = self._whitened.pop(key)
        else:
            room = min(max(_MOST_BYTES // max(self.columns.nbytes, 1), 1), _REMEMBERED)
            while len(self._whitened) >= room:
                self._whitened.pop(next(iter(self._whitened)))
            whitened = law(self.columns)
            norms = np.sqrt(np.einsum("ij,ij->j", whitened, whitened))
            per_column = np.repeat(self.widths, self.widths)
            whitened *= np.sqrt(law.n_kept / per_column) / np.where(norms > 0, norms, 1.0)
            products = {}
            for width in map(int, np.unique(self.widths)):
                blocks = whitened[:, self._template_and_column_indices(width)[1]].transpose(1, 0, 2)
                products[width] = blocks.transpose(0, 2, 1) @ blocks
            self._whitened[key] = _WhitenedTemplatesAndGrams(whitened, products)
        return self._whitened[key]


def _gram_eigensystems(squares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (n, width) and eigenvectors (n, width, width) of Gram matrices (n, width, width)."""
    width = squares.shape[-1]
    if width == 1:
        return squares[:, 0], np.ones_like(squares)
    if width > 2:
        values, axes = np.linalg.eigh(squares)
        return values, axes
    # Two columns, or one as above, are the rule and have a closed form (Jacobi's rotation).
    first, second, both = squares[:, 0, 0], squares[:, 1, 1], squares[:, 0, 1]
    angle = 0.5 * np.arctan2(2 * both, first - second)
    c, s = np.cos(angle), np.sin(angle)
    values = np.stack(
        [first * c * c + second * s * s + 2 * both * c * s, first * s * s + second * c * c - 2 * both * c * s]
    )
    return values.T, np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=2)


@dataclass(frozen=True, eq=False)
class _WhitenedTemplatesAndGrams:
    """All templates, whitened, (n_points, n_columns), and by width their Gram matrices, (n, width, width)."""

    templates: FloatArray
    products: dict[int, FloatArray]

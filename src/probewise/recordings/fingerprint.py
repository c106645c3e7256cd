"""A recording's fingerprint: two files with the same content have the same one, however they are laid out."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from probewise.recordings.description import description_text
from probewise.recordings.files import plan_columns
from probewise.recordings.patterns import Image
from probewise.recordings.plan import Recording
from probewise.recordings.table import csv_text, number_text

__all__ = ["fingerprint"]


def fingerprint(recording: Recording) -> str:
    """Hash what the recording says: SHA-256, hexadecimal, of the files that would be written for it.

    The free-text description, file names, column order and line ends play no part; rows, readings,
    scans, covariates, patterns and the instrument do.
    """
    plan = recording.plan
    columns = plan_columns(plan) | {"reading": [number_text(value) for value in recording.readings]}
    patterns = {
        name: replace(pattern, file="") if isinstance(pattern, Image) else pattern
        for name, pattern in sorted(plan.patterns.items())
    }
    digest = hashlib.sha256(csv_text(dict(sorted(columns.items()))).encode())
    digest.update(description_text(replace(plan.instrumentation, description=""), patterns).encode())
    for pattern in patterns.values():
        if isinstance(pattern, Image):
            digest.update(f"{pattern.albedo.shape}".encode() + pattern.albedo.astype("<f8").tobytes())
    return digest.hexdigest()

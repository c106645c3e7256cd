"""Fingerprint of a recording: equal for files with the same content, whatever their layout."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from probewise.recordings.description import description_text
from probewise.recordings.files import plan_columns
from probewise.recordings.patterns import Image
from probewise.recordings.plan import Recording
from probewise.recordings.table import csv_text, number_text


def fingerprint(recording: Recording) -> str:
    """Return the SHA-256, in hexadecimal, of a recording's content, written in a fixed order.

    The content is its rows, readings, scans, sessions, covariates, patterns and instrument; not the free-text
    description, file names, column order or line ends.
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

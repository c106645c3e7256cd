"""Progress on standard error; nothing where that is no terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Never

from tqdm import tqdm

from probewise.nested import State

__all__ = ["nested_progress"]


@contextlib.contextmanager
def nested_progress(*, quiet: bool) -> Iterator[Callable[[int, State], None]]:
    """Yield what `calibrate` calls after every round: a line for each number of Gaussians."""
    bars: dict[int, tqdm[Never]] = {}

    def show(n_gaussians: int, state: State) -> None:
        if n_gaussians not in bars:
            for bar in bars.values():
                bar.close()
            bars[n_gaussians] = tqdm(
                desc=f"{n_gaussians} Gaussian{'s' if n_gaussians > 1 else ''}",
                unit=" points",
                disable=True if quiet else None,
                leave=True,
            )
        bar = bars[n_gaussians]
        bar.update(state.n_dead - bar.n)
        bar.set_postfix_str(f"ln Z {state.log_z:.1f}, at most {state.log_z_remaining - state.log_z:+.1f} to come")

    try:
        yield show
    finally:
        for bar in bars.values():
            bar.close()

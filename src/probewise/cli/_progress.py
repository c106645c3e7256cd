"""Progress on standard error; nothing where that is no terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Never

from tqdm import tqdm

from probewise.nested import State

__all__ = ["nested_progress"]


@contextlib.contextmanager
def nested_progress(*, quiet: bool) -> Iterator[Callable[[int | str, State], None]]:
    """Yield what is called after every round: a line for each number of Gaussians, or hypothesis by name."""
    bars: dict[int | str, tqdm[Never]] = {}

    def show(what: int | str, state: State) -> None:
        if what not in bars:
            for bar in bars.values():
                bar.close()
            said = what if isinstance(what, str) else f"{what} Gaussian{'s' if what > 1 else ''}"
            bars[what] = tqdm(desc=said, unit=" points", disable=True if quiet else None, leave=True)
        bar = bars[what]
        bar.update(state.n_dead - bar.n)
        bar.set_postfix_str(f"ln Z {state.log_z:.1f}, at most {state.log_z_remaining - state.log_z:+.1f} to come")

    try:
        yield show
    finally:
        for bar in bars.values():
            bar.close()

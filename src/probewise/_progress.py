"""Progress on standard error, at a terminal or in a notebook; nothing where nobody looks."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Never

from tqdm import tqdm

from probewise.nested import State

__all__ = ["disabled", "nested_progress"]


def disabled(*, quiet: bool) -> bool | None:
    """Tell tqdm whether to show a bar: never, or where somebody looks, at a terminal or in a notebook."""
    if quiet:
        return True
    return False if "ipykernel" in sys.modules else None


@contextlib.contextmanager
def nested_progress(*, quiet: bool) -> Iterator[Callable[[int | str, State], None]]:
    """Yield what is called after every round: a line for each number of Gaussians, or hypothesis by name."""
    bars: dict[int | str, tqdm[Never]] = {}

    def show(what: int | str, state: State) -> None:
        if what not in bars:
            for bar in bars.values():
                bar.close()
            said = what if isinstance(what, str) else f"{what} Gaussian{'s' if what > 1 else ''}"
            bars[what] = tqdm(desc=said, unit=" points", disable=disabled(quiet=quiet), leave=True)
        bar = bars[what]
        bar.update(state.n_dead - bar.n)
        bar.set_postfix_str(f"ln Z {state.log_z:.1f}, at most {state.log_z_remaining - state.log_z:+.1f} to come")

    try:
        yield show
    finally:
        for bar in bars.values():
            bar.close()

"""Arguments under the names that they had in the last release: accepted for one release, with a warning."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def renamed_arguments(**new_by_old: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator (old="new", ...): the function accepts old keywords too, with a DeprecationWarning."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> T:
            for old, new in new_by_old.items():
                if old in kwargs and new not in kwargs:
                    said = f"{old} of {function.__name__} is {new} now"
                    warnings.warn(said, DeprecationWarning, stacklevel=2)
                    kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return call

    return decorate

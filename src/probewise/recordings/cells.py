"""Cells of a table as numbers: plain ones, and those that people write with commas, thousands and units."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from probewise._arrays import FloatArray

_WORDS = ("nan", "na", "n/a")
_SPELT = (map("".join, itertools.product(*zip(word, word.upper(), strict=True))) for word in _WORDS)
MISSING = frozenset(itertools.chain([""], *_SPELT))
"""Texts that mark a missing number."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# On texts of these characters float() accepts exactly what _NUMBER does ('infinity' and '1_000' have others).
_OF_NUMBERS = re.compile(r"[-+.0-9eE]*", re.ASCII)

_OTHER_WORDS = frozenset({"#n/a", "#na", "#value!", "#div/0!", "null", "none", "missing", "-", "--", "---", "----"})
_ODD_SIGNS = str.maketrans(
    {"\u2212": "-", "\u2013": "-", "\u2019": "'", **dict.fromkeys("\u00a0\u2007\u2009\u202f", " ")}
)
_QUANTITY = re.compile(
    r"(?P<number>[+-]? ?(?:[0-9](?:[0-9.,' ]*[0-9.,])?|[.,][0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r" *(?P<unit>(?![DdXx][+-]?\d)(?:[^\W\d_]|[%‰°])[^,;:]{0,15})?"  # not Fortran's 1.5D+01, nor 0x1
)
_GROUPS = {".": (",", " ", "'"), ",": (".", " ", "'")}  # between thousands, by decimal mark


def parsed_numbers(cells: Sequence[str]) -> FloatArray | None:
    """Convert cells to numbers in one pass; None if one of them is not a plain decimal number."""
    if _OF_NUMBERS.fullmatch("".join(cells)) is None:
        return None
    try:
        return np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
    except ValueError:
        return None


def first_cell_without_number(
    cells: Sequence[object], *, missing: bool = True, largest: float = math.inf
) -> int | None:
    """Return the index of the first cell that is no number up to `largest` and, if `missing`, not missing; or None.

    One that is no number however it is written comes before those that another way of writing would explain.
    """
    first: int | None = None
    for k, cell in enumerate(cells):
        text = str(cell).strip()
        if (missing and text in MISSING) or (_NUMBER.fullmatch(text) and abs(float(text)) <= largest):
            continue
        if not looks_like_number(text):
            return k
        first = k if first is None else first
    return first


def count_numbers(cells: Sequence[str]) -> int:
    """Count the cells that hold a plain decimal number (float() would accept 'infinity' and '1_000' too)."""
    if parsed_numbers(cells) is not None:
        return len(cells)
    return sum(n for cell, n in Counter(cells).items() if _NUMBER.fullmatch(cell))


class UnclearCellError(ValueError):
    """Report a column that can be read in several ways, or in none: the index of a cell, what is allowed there."""

    def __init__(self, index: int, allowed: str, *, name: str = "") -> None:
        self.name, self.index, self.allowed = name, index, allowed
        super().__init__(allowed)


def is_missing(cell: str) -> bool:
    """Return whether a cell is empty or holds a word for a missing number."""
    return cell in MISSING or cell.lower() in _OTHER_WORDS


def looks_like_number(cell: str) -> bool:
    """Return whether a cell holds a number, however it is written, with a unit or without."""
    return _QUANTITY.fullmatch(cell.translate(_ODD_SIGNS)) is not None


def unit_of_cells(cells: Sequence[str]) -> str:
    """Return the unit that stands in all cells of a column of numbers; "" if there is none."""
    found = _Quantities.of(cells)
    return "" if found is None else found.unit


def plain_cells(
    odd: Mapping[str, Sequence[str]], usual: Callable[[], Mapping[str, Sequence[str]]]
) -> tuple[dict[str, list[str]], list[str]]:
    """Rewrite columns of numbers as plain numbers: decimal commas, thousands, units, words for what is missing.

    `odd` are the cells by name of the columns that are not plain numbers throughout; `usual` returns those that are.
    Where all numbers of a column can be read with either decimal mark, it has that of the other columns. Returns the
    rewritten columns by name, and notes on how they were read; UnclearCellError if a comma may be a decimal comma or
    separate thousands.
    """
    columns = dict(odd)
    read = {name: found for name, cells in odd.items() if (found := _Quantities.of(cells)) is not None}
    if any("," in number for found in read.values() for number in found.numbers.values()):
        columns |= usual()
        others = {name: _Quantities.of(cells) for name, cells in columns.items() if name not in odd}
        read |= {name: found for name, found in others.items() if found is not None}
    marks = {name: found.decimal_marks() for name, found in read.items()}
    certain = {mark for own in marks.values() if len(own) == 1 for mark in own}
    out: dict[str, list[str]] = {}
    commas, grouped, notes = list[str](), list[str](), list[str]()
    for name, found in read.items():
        own = marks[name] if len(marks[name]) < 2 else marks[name] & certain
        if len(own) != 1 and (len(marks[name]) == 0 or name not in odd):
            continue  # texts, or plain numbers of which nothing else says otherwise
        numbers = found.numbers.values()
        if len(own) != 1 and any("," in number for number in numbers):
            k = next(k for k, cell in enumerate(columns[name]) if "," in cell)
            allowed = "a number without thousands: the comma may be a decimal comma or set them apart"
            raise UnclearCellError(k, allowed, name=name)
        mark = own.pop() if len(own) == 1 else "."
        if mark == "," and any("," in number for number in numbers):
            commas.append(name)
        if any(group in number for number in numbers for group in _GROUPS[mark]):
            grouped.append(name)
        notes += [f"{name} in {found.unit}, as its cells say"] * bool(found.unit)
        notes += [f"{', '.join(map(repr, sorted(found.words)))} missing in {name}"] * bool(found.words)
        cells = found.plain(mark)
        out[name] = [cells[cell] for cell in columns[name]]
    for said, names in (("thousands set apart", grouped), ("decimal commas", commas)):
        notes[:0] = [f"{said} in {', '.join(names)}"] * bool(names)
    return out, notes


class _Quantities:
    """The distinct cells of a column of numbers, the number in each, their unit, and the words for missing ones."""

    def __init__(self, numbers: dict[str, str], unit: str, words: set[str], missing: set[str]) -> None:
        self.numbers, self.unit, self.words, self.missing = numbers, unit, words, missing

    @classmethod
    def of(cls, cells: Sequence[str]) -> _Quantities | None:
        """Take a column apart; None if it is one of texts, or if its units differ."""
        numbers, units, words, missing = dict[str, str](), set[str](), set[str](), set[str]()
        for cell in dict.fromkeys(cells):
            if cell in MISSING:
                missing.add(cell)
            elif cell.lower() in _OTHER_WORDS:
                words.add(cell)
            elif (found := _QUANTITY.fullmatch(cell.translate(_ODD_SIGNS))) is not None:
                numbers[cell] = found["number"].replace("- ", "-").replace("+ ", "+")
                units.add(found["unit"] or "")
            else:
                return None
        return cls(numbers, next(iter(units)), words, missing) if len(units) == 1 else None

    def decimal_marks(self) -> set[str]:
        """Return the decimal marks with which all numbers can be read, in one of the ways to set thousands apart."""
        marks, exponent = set[str](), r"(?:[eE][+-]?\d+)?"
        for mark, groups in _GROUPS.items():
            point = re.escape(mark)
            for group in map(re.escape, groups):
                whole = rf"(?:\d+|[1-9]\d{{0,2}}(?:{group}\d{{3}})+)(?:{point}\d*)?"
                form = re.compile(rf"[+-]?(?:{whole}{exponent}|{point}\d+{exponent})")
                if all(map(form.fullmatch, self.numbers.values())):
                    marks.add(mark)
        return marks

    def plain(self, mark: str) -> dict[str, str]:
        dropped = str.maketrans("", "", "".join(_GROUPS[mark]))
        out = {cell: number.translate(dropped).replace(mark, ".") for cell, number in self.numbers.items()}
        return out | dict.fromkeys(self.words, "") | {cell: cell for cell in self.missing}

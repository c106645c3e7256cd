"""Forms: generic effects that a simulator may leave out, each bound to a column, parameter, state or the reading."""

from probewise.systems.forms.binding import WORDS, bind_forms
from probewise.systems.forms.inputs import driving_columns
from probewise.systems.forms.reference import Form, ReferenceFit

__all__ = ["WORDS", "Form", "ReferenceFit", "bind_forms", "driving_columns"]

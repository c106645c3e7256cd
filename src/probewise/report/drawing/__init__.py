"""Line drawings written as SVG: what a diagnosis shows, without a plotting library's second of start and draw."""

from probewise.report.drawing.marks import Band, Bars, Boxes, Dots, Line, Mark, Rule, Span
from probewise.report.drawing.panel import Panel, drawing

__all__ = ["Band", "Bars", "Boxes", "Dots", "Line", "Mark", "Panel", "Rule", "Span", "drawing"]

"""The reports of a restoration and of a steadied video: self-contained HTML files."""

from .page import check_report as check_report
from .page import render_report as render_report
from .page import write_report as write_report
from .steadied import SteadyFigures as SteadyFigures
from .steadied import write_steady_report as write_steady_report

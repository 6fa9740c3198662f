"""The report of a restoration: one self-contained HTML file."""

from .page import check_report as check_report
from .page import render_report as render_report
from .page import write_report as write_report

"""A restoration as one HTML file that needs nothing else: no network, no other file, no server."""

from .page import check_report as check_report
from .page import render_report as render_report
from .page import write_report as write_report

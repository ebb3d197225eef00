"""The report of a run: pictures and one page."""

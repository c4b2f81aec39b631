"""Charts as data, and what draws them: SVG for pages, matplotlib for papers, characters for logs.

They know nothing of results; :mod:`pemviz.reports.charts` says what charts there are of one. The
rerun viewer's engine stands with the recording.
"""

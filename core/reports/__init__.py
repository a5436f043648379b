"""Reports: what a fit or a check found, as text, HTML, figures, layouts and annotated recordings.

May import every room above: base to proposal.
"""

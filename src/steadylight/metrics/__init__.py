"""Metrics: error of still images, flicker of frame sequences, and the comparison of two runs.

Every measure states its formula; `docs/quality.md` has the results for this version.
"""

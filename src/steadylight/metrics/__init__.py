"""HOW GOOD: error of still images, flicker of sequences of frames, and the comparison of two runs.

Every measure states its formula; `docs/quality.md` holds what they say of this version.
"""

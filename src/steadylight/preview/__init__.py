"""Preview: in seconds, a page and a picture that show how a scene and its camera path were understood.

Quick path-traced frames, a plan from above, the size of rooms, and what was converted or left out.
"""

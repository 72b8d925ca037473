"""Radiance's scenes: `octree` keeps them for Radiance's own programs, `conversion` turns them into Mitsuba's.

Both parse text with `grammar` and run the commands in it with `commands`: known programs only, and no shell.
"""

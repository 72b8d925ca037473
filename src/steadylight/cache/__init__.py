"""THE IRRADIANCE CACHE of the Mitsuba renderer: records as NumPy arrays, their look-up, merge, parts and file format.

Nothing here knows a renderer's kernels; the readable twins of the fast ones live here.
"""

"""THE IRRADIANCE CACHE of the Mitsuba renderer: records as NumPy arrays, their look-up, merge, parts and file format.

Nothing here depends on a renderer's kernels. What a kernel computes fast, such as the look-up, also exists here in
readable form.
"""

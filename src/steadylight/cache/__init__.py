"""THE IRRADIANCE CACHE of the Mitsuba renderer: records as NumPy arrays, their look-up, merge, parts and file format.

Nothing here depends on a renderer's kernels. Algorithms that have a fast kernel, such as the look-up, also exist here
in readable form.
"""

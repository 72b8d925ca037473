"""The renderer on Mitsuba 3 and Dr.Jit: irradiance caching by wavefront kernels on the CPU or a GPU.

Nothing here may be imported before `backend.use_variant` has chosen a Mitsuba variant, but `plugin`, which does so.
"""

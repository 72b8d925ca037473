"""The renderer on Mitsuba 3 and Dr.Jit: irradiance caching by wavefront kernels on the CPU or a GPU.

No module but `plugin` may be imported before `backend.use_variant` has set a Mitsuba variant; `plugin` does so itself.
"""

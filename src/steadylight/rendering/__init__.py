"""HOW light is computed: the Mitsuba and Dr.Jit code. Call `backend.use_variant` before anything else here."""

"""WHEN: the plan (data), the request, what a worker does, and the run that brings them together."""

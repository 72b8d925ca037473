"""WHEN: the plan (data), the request, what a worker does with a task, and the run that brings them together.

Of rendering it knows `renderers.base` alone.
"""

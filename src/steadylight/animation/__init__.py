"""Animation: the request, the plan (data), the tasks on a worker, and the run that combines them.

It knows rendering only through `renderers.base`.
"""

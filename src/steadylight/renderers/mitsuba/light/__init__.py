"""Light at one vertex of a path: what is emitted, what emitters send, and which emitters are worth a shadow ray.

Frames, gather and the extra samples of noisy pixels all use the estimator that is written down here once.
"""

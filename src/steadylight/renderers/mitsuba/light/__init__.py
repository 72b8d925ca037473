"""Light at one vertex of a path: emission, emitter sampling, and the choice of emitters that are worth a shadow ray.

Frames, gather and the extra samples of noisy pixels share one implementation of the estimator.
"""

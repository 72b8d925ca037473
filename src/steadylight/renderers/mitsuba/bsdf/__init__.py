"""What kernels must know of BSDFs before they are compiled: lobes, specular layers, delta dielectrics.

Lobes are sampled one at a time here, because the cache already answers for the diffuse one.
"""

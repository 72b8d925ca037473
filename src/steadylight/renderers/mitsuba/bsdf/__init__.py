"""What kernels need to know about BSDFs before they are compiled: lobes, specular layers, delta dielectrics.

Lobes are sampled separately here, because the cache already provides the diffuse one.
"""

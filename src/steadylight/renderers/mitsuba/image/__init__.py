"""From samples to a picture: pixel samples, reconstruction, adaptive samples and denoising.

Sums run in a fixed order, so that the same samples give the same bytes.
"""

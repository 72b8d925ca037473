"""From samples to a picture: pixel samples, reconstruction, adaptive sampling and denoising.

Sums are taken in a fixed order, so the same samples give the same bytes.
"""

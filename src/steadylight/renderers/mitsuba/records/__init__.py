"""Making irradiance records, and looking them up on the device.

A record is gathered by pilot and refinement samples of its hemisphere; records are placed at points that none covers
yet.
"""

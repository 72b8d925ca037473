"""Making irradiance records, and looking them up on the device.

A record is gathered by pilot and refinement samples of its hemisphere; where records go follows from the points that no
record answers yet.
"""

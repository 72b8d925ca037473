"""THE IRRADIANCE CACHE: records, look-up, spatial index, placement, merge and file format. NumPy only."""

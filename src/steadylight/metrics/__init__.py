"""HOW GOOD: error of still images, flicker of sequences, and the comparison of two runs."""

"""HOW GOOD: error of still images, flicker of films, and the comparison of two runs."""

"""Microscope images: stacks of any format in, movies with a known truth, particles found."""

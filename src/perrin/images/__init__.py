"""From a microscope stack to particles: what spheres look like, where they are."""

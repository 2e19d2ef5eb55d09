"""perrin: measure how rigid clusters of colloidal particles diffuse and turn."""

__version__ = "0.1.0"

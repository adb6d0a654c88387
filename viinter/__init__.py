"""View interpolation with implicit neural representations of images (VIINTER, SIGGRAPH Asia 2022)."""

__version__ = "0.1.0"

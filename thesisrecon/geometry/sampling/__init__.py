"""Values between pixels."""

from thesisrecon.geometry.sampling.kernels import cubic_weights

__all__ = ["cubic_weights"]

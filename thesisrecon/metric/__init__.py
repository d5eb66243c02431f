"""After chapter 7: postponed cameras, metric refinement, intervals and the self-check."""

from thesisrecon.metric.upgrade_and_bundle import UpgradeAndBundle

__all__ = ["UpgradeAndBundle"]

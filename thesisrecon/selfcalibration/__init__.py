"""Chapter 7: self-calibration."""

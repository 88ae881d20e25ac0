"""Exposures of one beam, and all that is known of them."""

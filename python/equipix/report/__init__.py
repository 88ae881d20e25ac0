"""Results as pages for people: figures with units, maps, limits, findings, provenance."""

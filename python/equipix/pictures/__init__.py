"""Pictures of calibrations and plans; they need matplotlib, the extra ``plot``."""

"""Pages of studies and challenges."""

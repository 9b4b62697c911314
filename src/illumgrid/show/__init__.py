"""Pictures: still, swept, and on a page."""

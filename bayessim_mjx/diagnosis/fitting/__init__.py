"""Models fitted to windows of the logs by multiple shooting. Knows no verdict."""

"""From findings to what is told and saved."""

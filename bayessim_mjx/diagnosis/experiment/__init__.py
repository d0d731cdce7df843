"""The next experiment: a safe motion that separates what these logs cannot tell apart."""

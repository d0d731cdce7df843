"""The diagnosis's evidence: each model's marginal likelihood with a missing force, and what follows from it alone."""

"""What a fitted model leaves: the force that is missing, and where, when and with what it goes."""

"""bayessim_mjx: adaptive domain randomisation and sim-to-real gap diagnosis on MuJoCo MJX."""

"""Recordings of other tools as CSV files and the map that reads them: MCAP, ROS bags, LeRobot, HDF5, PACE."""

"""Recordings of other tools as a folder of CSV files and the map that reads them: MCAP, ROS bags, LeRobot, HDF5."""

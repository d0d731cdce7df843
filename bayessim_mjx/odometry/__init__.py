"""The motion of a floating base that nobody measured, from an inertial measurement unit, encoders and feet."""
